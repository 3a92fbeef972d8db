"""A camera that renders the limb and its tags."""
