"""Show the signals of a run in TensorBoard while it learns.

Install and run it:

    pip install tensorboardX tensorboard
    python examples/tensorboard_sink.py runs/curves
    tensorboard --logdir runs/curves
"""

import sys
from math import isfinite

from tensorboardX import SummaryWriter

import cdmisfa


class TensorBoard(cdmisfa.Sink):
    """Write every scalar signal of an iteration as a point of a curve."""

    def __init__(self, folder):
        self.writer = SummaryWriter(folder, flush_secs=5)

    def block(self, block, signals, learner):
        for name, signal in cdmisfa.SIGNALS.items():
            if not signal.dims and isfinite(value := getattr(signals, name)):
                self.writer.add_scalar(name, value, signals.iteration)

    def event(self, t, iteration, text, level="INFO"):
        self.writer.add_text("events", text, iteration)

    def finish(self):
        self.writer.close()


if __name__ == "__main__":
    cdmisfa.learn("oscillatory", max_modules=1, sinks=[TensorBoard(sys.argv[1])])
