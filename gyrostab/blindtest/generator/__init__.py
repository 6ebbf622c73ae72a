"""An independent generator of recordings: environment, noise, effects and telemetry, with physics of its own."""
