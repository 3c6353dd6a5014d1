"""The learnt modules of the simulator: exposure, noise, aperture, and the networks they run."""
