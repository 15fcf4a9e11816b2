"""One protocol on one rig, in this process and by a guardian: the same steps."""
