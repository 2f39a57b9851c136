"""The work behind the verbs of the command line: plain functions of a `jaxnav.app.config.Config`."""
