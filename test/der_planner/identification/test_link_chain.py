"""The foreign limb of other tests does what it says of itself."""

import numpy as np
import pytest
from link_chain import MASS_PER_LENGTH, LinkChain


@pytest.mark.parametrize("gravity", [(0.0, 2.0, 0.0), (9.81, 0.0, 0.0), (-4.0, 1.0, -8.0)])
def test_it_rests_where_torques_balance(gravity):
    chain = LinkChain(1, gravity, masses=[(chain_length := LinkChain.length, 0.03)])
    chain.advance((6000.0, -3000.0), 60.0)
    links = chain._built
    nodes = chain.nodes()[1:]
    middle = 0.5 * (nodes[1:] + nodes[:-1])
    mass = MASS_PER_LENGTH * links.length
    pressure = chain._state.pressure
    bend = np.diff(np.append(0.0, chain._state.heading)) - links.rest
    assert nodes[-1] @ nodes[-1] < chain_length**2
    for i in range(len(mass)):
        m = links.owner[i]
        spring = links.stiffness[i] * bend[i] * (1 + links.hardening[i] * bend[i] ** 2)
        friction = np.sum(links.slip[m] * chain._state.stuck[m] / links.width)
        drive = links.gain[m] @ (pressure[m] * [1, -1])
        arms = np.append(mass[i:, None] * (middle[i:] - nodes[i]), [0.03 * (nodes[-1] - nodes[i])])
        x, y = arms.reshape(-1, 2).sum(axis=0)
        weight = x * gravity[1] - y * gravity[0]
        assert drive + weight == pytest.approx(spring + friction, abs=2e-6)
