"""The guide through the first power-up."""
