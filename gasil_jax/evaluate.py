"""``python -m gasil_jax.evaluate``: see `gasil_jax.cli.evaluate`."""

import sys

from gasil_jax.cli.evaluate import main

if __name__ == "__main__":
    sys.exit(main())
