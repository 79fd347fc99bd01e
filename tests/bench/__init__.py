"""What accuracy costs in time, as ratios within one run."""
