"""Which instrument is at which port: `ports` lists them, `places` asks who is there, `commands` has `bench find`."""
