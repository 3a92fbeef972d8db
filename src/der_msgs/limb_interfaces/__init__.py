"""The Python half of the graph's contract: topics, QoS profiles, diagnostics, clean exit."""
