"""Which instrument is at which port: `ports` lists ports, `places` asks who is there; `bench rig find`."""
