"""The commands: each composes planning, plant, guidance and report. No algorithm lives here."""
