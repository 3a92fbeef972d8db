"""Pressure in, shape out: what a limb does under its commands, for the rod and for the arcs.

`air` and `material` are the two laws between a command and the pressure that a linear limb feels,
`commands` is their inverse, `bending` says what a bend angle is, `balance` inverts the limb's own
dynamics, and `response.simulate` puts all of it together, with its exact derivative.
"""
