"""The perception roles: their protocols (`roles`), classical code (`classical`) and simulated models (`stubs`)."""
