"""What camera and chambers say of a limb: its state, what its model lacks, and what touches it."""
