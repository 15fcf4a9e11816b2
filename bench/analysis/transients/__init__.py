"""What the transients of a run show: the dynamics of its actuator and of the response of its specimen.

`recording` reads the run, `actuator` and `response` find the dynamics, `identification` puts together what a model
file keeps of them. No device is touched.
"""
