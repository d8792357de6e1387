"""``python -m gasil_jax.plot``: see `gasil_jax.cli.plot`."""

import sys

from gasil_jax.cli.plot import main

if __name__ == "__main__":
    sys.exit(main())
