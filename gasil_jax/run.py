"""``python -m gasil_jax.run``: see `gasil_jax.cli.run`."""

import sys

from gasil_jax.cli.run import main

if __name__ == "__main__":
    sys.exit(main())
