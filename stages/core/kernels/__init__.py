"""Numerical kernels in Warp, Triton and C++, and the PyTorch code that specifies them.

Warp compiles kernels for CPUs and GPUs. Warp does not vectorise across the threads of a launch, so the inner loops on
CPUs are C++ with SIMD vector types, passed to Warp as strings (`wp.func_native`). Triton, which needs a GPU, is used
for the fused inference step of the force field; its modules are imported only where `compilers.TRITON` is true.

| file                          | written in                  | specified and tested by                              |
|-------------------------------|-----------------------------|------------------------------------------------------|
| skinning                      | Warp                        | `skin_gaussians_reference` in the file               |
| sh_rotation                   | C++ and CUDA snippets       | `geometry.harmonics.rotate_sh`                       |
| depth_lookup                  | Warp                        | `DepthLookup` in the file                            |
| nearest_rotations             | Warp                        | `geometry.rotations.nearest_rotation`                |
| sphere_shadows                | Warp                        | `blocked_light_reference` in the file                |
| average_linkage               | C++ snippet                 | `average_linkage_reference` in the file              |
| adam                          | PyTorch (CPU), Warp         | `torch.optim.Adam`                                   |
| semi_global                   | PyTorch (CPU), CUDA snippet | `path_costs_reference` in the file                   |
| splat/projection, harmonics   | C++ and CUDA snippets       | `projection.project_reference`                       |
| splat/binning                 | C++ snippets, CPU only      | `depth_order_reference` in the file                  |
| splat/tiles                   | Warp, CUDA only             | `binning.depth_order_reference`                      |
| splat/compositing(_adjoint)   | C++ snippets, CPU only      | `compositing.composite_reference`                    |
| splat/compositing_cuda        | CUDA snippets               | `compositing.composite_reference`                    |
| splat/ssim, ssim_pixel        | C++ snippets (CPU), Warp    | `ssim.ssim_reference`                                |
| splat/photometric_loss        | PyTorch (CPU), Warp         | `photometric_loss_reference` in the file             |
| mpm/transfers, grid, nodes,   | Warp with C++ and CUDA      | `transfers.substep_reference` (one free substep);    |
|   split, fused, exact         |   snippets                  |   split and fused are tested against each other      |
| mpm/contact, active           | Warp                        | momentum, Coulomb's law, slopes                      |
| mpm/pins                      | Warp                        | beams whose parts are pinned                         |
| mpm/constitutive              | Warp                        | theory, and `corotated_reference` in the file        |
| field/normals                 | Warp                        | `normals_and_spacing_reference` in the file          |
| field/rigid_motion            | Warp                        | `models.field.rigid_body` (drift, pose)              |
| field/contact_search,         | Warp                        | `tests/core/kernels/contact_reference.py`, and       |
|   near_points, surface_lookup |                             |   `physics.solid_surface`                            |
| field/contact_solve,          | Warp with C++ and CUDA      | `tests/core/kernels/contact_reference.py`            |
|   contact_impulses,           |   snippets                  |                                                      |
|   newton_system               |                             |                                                      |
| field/rigid_frames,           | Warp                        | slides, slopes, rebounds, towers, rows of balls      |
|   contact_turns, groups,      |                             |                                                      |
|   contact_patches             |                             |                                                      |
| field/nearest, perceptron     | Triton                      | `..._reference` in each file                         |
| field/skinny_matmul           | Triton                      | `A @ x` in double precision                          |
| field/neighbourhoods          | Triton                      | `models.field.rest_shape`                            |
| field/bodies, broad_phase,    | Triton                      | `ForceField.step` in `models.field.force_field`      |
|   contact_features,           |                             |                                                      |
|   contact_messages,           |                             |                                                      |
|   velocity_update,            |                             |                                                      |
|   deformation_features        |                             |                                                      |

`interop` passes tensors, device and stream between PyTorch and Warp; `threads` runs CPU launches in parallel;
`operators` hides kernels from torch.compile; `compilers` tells which compilers are available;
`simd`, `splat/pixel_blocks`, `field/vec3` and `field/layers` hold code shared by several kernels. The kernels are
called by `raster`, `physics` and `models`.
"""
