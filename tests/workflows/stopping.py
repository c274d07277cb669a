"""A request that stops a job at a given step."""

from eddies.parallel.stop import StopRequest


class StopAtStep(StopRequest):
    """Stops a job after a number of calls; with `every_step` a checkpoint is due at each call."""

    def __init__(self, comm, steps=10**9, every_step=False):
        super().__init__(comm)
        self.left, self.every_step = steps, every_step

    def __call__(self):
        self.signals = [10] if self.left <= 0 else []
        self.left -= 1
        return super().__call__()

    @property
    def checkpoint_due(self):
        return self.every_step or super().checkpoint_due
