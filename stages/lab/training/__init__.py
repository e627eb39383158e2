"""Training of the dynamics models, the segmentation network and the splat head."""
