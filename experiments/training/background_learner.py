"""Learning that a thread of its own starts, so that acting never waits for the start."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import sndjax

from .learners import Compile, Learned, Learner


class BackgroundLearner:
    """A learner whose programs are started by another thread, one after another.

    Starting a program does not wait for its end on a CPU. On a GPU it may: XLA looks at the
    condition of a loop or a branch on the host, and an update has one in every minibatch.
    """

    def __init__(self, learner: Learner):
        """Start the thread.

        Args:
          learner: what is started.
        """
        self.learner = learner
        self.thread = ThreadPoolExecutor(1, "learner")
        self.begun: list[Future[None]] = []  # of this iteration, not waited for

    def compile(self, compiler: Compile, train: sndjax.TrainState, batch: Any) -> float:
        return self.learner.compile(compiler, train, batch)

    def begin(self, train: sndjax.TrainState, batch: Any) -> None:
        self.begun = [self.thread.submit(self.learner.begin, train, batch)]

    def learn_policy(self) -> sndjax.Actor:
        last = self.thread.submit(self.learner.learn_policy)
        self.wait()
        return last.result()

    def advance(self, share: float) -> None:
        self.begun.append(self.thread.submit(self.learner.advance, share))

    def finish(self) -> Learned:
        last = self.thread.submit(self.learner.finish)
        self.wait()
        return last.result()

    def wait(self) -> None:
        """Wait for everything that was begun; the first error is the cause of the others."""
        begun, self.begun = self.begun, []
        for task in begun:
            task.result()
