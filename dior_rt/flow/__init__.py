"""Flow matching: the schedule of flow times, the solvers, and the sampler that uses both."""
