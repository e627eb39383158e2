"""Material point method kernels."""
