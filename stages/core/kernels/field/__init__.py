"""Kernels of the force field: its learned step in Triton (GPU only), its contact solver and rigid bodies in Warp.

One step with learned contacts launches, in this order (see `stages.core.models.field.fused_step`): `bodies` (half a
drift step), `broad_phase` (contact point pairs), `contact_features`, `contact_messages`, `velocity_update` (rigid
bodies), `skinny_matmul` (neighbourhood averages), `deformation_features`, `velocity_update` (displacements). A frame
with solved contacts is one launch of `rigid_frames`. `stages.core.kernels` has a table of all modules.
"""
