"""Where things are: the camera from fixed tags, tags in their plane, the limb's tip and curve."""
