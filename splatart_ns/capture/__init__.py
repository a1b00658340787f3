"""What is read: states, frames, labels, masks."""
