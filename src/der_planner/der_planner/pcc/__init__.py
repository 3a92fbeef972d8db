"""The piecewise-constant-curvature baseline."""
