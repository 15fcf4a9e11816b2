"""Models with time: operators in a chain with delay, lag and creep, and equations of motion."""
