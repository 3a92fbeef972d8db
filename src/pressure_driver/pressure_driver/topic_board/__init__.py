"""A lab's own driver of valves as a board."""
