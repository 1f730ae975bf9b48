"""``python -m warp_neumat`` is ``neumat``."""

from warp_neumat.cli import main

if __name__ == "__main__":
    main()
