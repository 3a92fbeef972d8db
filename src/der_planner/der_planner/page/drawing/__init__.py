"""Drawing a path on the picture: what is reachable, previews, kept drawings, and the panel."""
