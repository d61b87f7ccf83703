"""What is private or unstable in JAX and XLA, and how programs are compiled."""
