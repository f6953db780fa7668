"""How many steps a run may take in one launch: so many that the host may stop it within some tenths of a second."""

# Particle-steps of the first launch, wall time of the others, s, and the growth from one to the next. The bytes of a
# run depend on none of them.
FIRST, LAUNCH, GROWTH = 1_000_000, 0.4, 4


class LaunchBudget:
    """Follows the speed of a run.

    Attributes:
        steps: of the next launch, at least 1.
    """

    def __init__(self, particles: int) -> None:
        self.steps = max(1, FIRST // particles)

    def took(self, steps: int, seconds: float) -> None:
        """Take note of the last launch: its steps, and its wall time, s."""
        if steps > 0 and seconds > 0:
            self.steps = max(1, min(GROWTH * self.steps, int(LAUNCH * steps / seconds)))
