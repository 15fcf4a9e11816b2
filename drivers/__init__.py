"""One module an instrument: the driver that speaks its real protocol on a real wire."""
