"""The Python half of the graph's contract: topic names, QoS profiles, diagnostics and clean exit."""
