"""Planning under gravity and with what a limb carries: rest, poses, overload, sag."""
