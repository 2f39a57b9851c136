"""`python -m jaxnav` is the command line."""

from jaxnav.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
