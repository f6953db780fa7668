"""What surfaces and liquids share: light, shadows, what stands behind them, and particles grouped by material."""
