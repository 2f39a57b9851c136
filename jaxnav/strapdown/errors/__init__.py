"""How errors of position, velocity and attitude grow, one module per mechanization."""
