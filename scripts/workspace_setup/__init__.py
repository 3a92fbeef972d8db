"""Parts of `workspace`: what sets up the machine. Only the standard library is imported."""
