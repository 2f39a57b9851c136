"""The command line: configuration, jobs, results."""
