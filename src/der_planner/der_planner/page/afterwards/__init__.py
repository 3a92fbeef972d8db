"""What is looked at afterwards: earlier experiments, and bags replayed in the browser."""
