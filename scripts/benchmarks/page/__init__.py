"""The operator's page in real browsers: vent, cost, memory, and the driver's punctuality."""
