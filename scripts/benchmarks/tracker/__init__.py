"""The tracker on rendered pictures with known corners, in a graph, and beside the C library."""
