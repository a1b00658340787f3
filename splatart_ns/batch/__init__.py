"""Many captures to many bundles, on one machine or on a Ray cluster."""
