"""A rod in a coordinate plane: two unknowns a node."""
