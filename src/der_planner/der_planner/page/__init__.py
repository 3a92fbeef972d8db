"""The operator's page: what the limb does, in a browser, and the buttons that command it.

`situation`, `access`, `guard`, `operators`, `picture`, `overlay` and `server` know nothing of ROS;
`node` binds them to the graph.
"""
