"""The thermo-piezoelectric hybrid: a cantilever moved far by heat and finely by voltage."""
