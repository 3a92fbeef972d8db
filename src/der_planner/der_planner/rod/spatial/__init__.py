"""A rod in space: three positions a node and an angle an edge."""
