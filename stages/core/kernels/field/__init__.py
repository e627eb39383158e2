"""Kernels of the learned force field, in Triton (GPU only) but for `normals` and `rigid_motion`, which are in Warp.

One time step launches, in this order (see `stages.core.models.field.fused_step`): `bodies` (half a drift step),
`broad_phase` (contact point pairs), `contact_features`, `contact_messages`, `velocity_update` (rigid bodies),
`skinny_matmul` (neighbourhood averages), `deformation_features`, `velocity_update` (displacements).
"""
