"""The limb from rigid bodies that somebody else tracks: motion capture, other trackers of tags."""
