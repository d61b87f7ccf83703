"""The vocabulary: handles, markers, the kinds of effect, state, trajectory and results."""
