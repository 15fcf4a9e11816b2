"""The VO2-coated microcantilever: curvature against temperature, with non-monotonic hysteresis."""
