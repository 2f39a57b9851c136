"""`python -m jaxnav` is the command line."""

from jaxnav.app.console import console

if __name__ == "__main__":
    console()
