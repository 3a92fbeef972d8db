"""A valve board on a pseudo-terminal, with its pneumatics."""
