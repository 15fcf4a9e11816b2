"""The guardian: the one process that opens the lines of real instruments, and keeps them safe without the bench."""
