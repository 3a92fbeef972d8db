"""Names of every topic and service of the graph, relative to the namespace `/limb`."""

NAMESPACE = "limb"

COMMAND = "command"
PATH = "path"
PLAN = "plan"
PRESSURE_SETPOINT = "pressure_setpoint"
TIP_REFERENCE = "tip_reference"
PRESSURE_STATE = "pressure_state"
IMAGE = "camera/image_raw"
CAMERA_INFO = "camera/camera_info"
TAGS = "tags"
LIMB_STATE = "state"
ESTIMATE = "estimate"
CONTACT = "contact"
SHAPE_MARKERS = "shape_markers"
DIAGNOSTICS = "/diagnostics"

# The twin's own topics. Planner, driver and tracker never subscribe to them.
TWIN_CHAMBER_PRESSURES = "twin/chamber_pressures"
TWIN_BOARD_COMMANDS = "twin/board_commands"
TWIN_SHAPE = "twin/shape"
TWIN_GROUND_TRUTH = "twin/ground_truth"
TWIN_PUSH = "twin/push"

BASE_FRAME = "limb_base"
