"""The nodes, and what `ros2 run der_planner` starts: each is the process of one of them.

A node's module is loaded only then: signals end the process quietly while it loads.
"""

from functools import partial

from limb_interfaces.entry import run_module

run_planner = partial(run_module, "der_planner.nodes.planner")
run_recorder = partial(run_module, "der_planner.nodes.recorder")
run_limb_twin = partial(run_module, "der_planner.nodes.limb_twin")
run_page = partial(run_module, "der_planner.page.node")
