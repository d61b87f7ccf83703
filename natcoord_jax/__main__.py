"""`python -m natcoord_jax` is the command line."""

from natcoord_jax.cli import main

raise SystemExit(main())
