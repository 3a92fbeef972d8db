"""Plans chamber pressures of a soft limb with a discrete elastic rod, records runs and evaluates them."""
