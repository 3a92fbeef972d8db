"""What the driver watches: readings, chambers that follow, a board that hears."""
