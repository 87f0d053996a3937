"""The commands: `hcnaf` where models are made, `hcnaf-run` where they are used."""
