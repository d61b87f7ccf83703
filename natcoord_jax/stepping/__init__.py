"""Steps, Newton's iteration, implicit derivatives and rollouts; no effect is known here."""
