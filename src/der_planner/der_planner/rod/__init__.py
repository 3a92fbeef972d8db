"""The discrete elastic rod with explicit inputs."""
