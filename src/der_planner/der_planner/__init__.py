"""Plans the pressures of a soft limb with a discrete elastic rod; records and evaluates runs."""
