"""`python -m jaxnav` is the command line."""

from jaxnav.cli import console

if __name__ == "__main__":
    console()
