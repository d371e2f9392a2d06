"""Time stepping: integration, the clock, the stable step, energies, many steps in one launch."""
