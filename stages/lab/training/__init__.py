"""Training of dynamics models and of the splat head."""
