"""``python -m gasil_jax.sweep``: see `gasil_jax.cli.sweep`."""

import sys

from gasil_jax.cli.sweep import main

if __name__ == "__main__":
    sys.exit(main())
