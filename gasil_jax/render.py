"""``python -m gasil_jax.render``: see `gasil_jax.cli.render`."""

import sys

from gasil_jax.cli.render import main

if __name__ == "__main__":
    sys.exit(main())
