"""The work of the command line's verbs: plain functions of a `jaxnav.app.config.Config`."""
