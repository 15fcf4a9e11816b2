"""Commands in this process; Hypothesis without deadlines, as the first call of a compiled loop loads it."""

from hypothesis import settings

settings.register_profile("compiled", deadline=None)
settings.load_profile("compiled")
