"""An executor without processes: jobs run at once, from pickled arguments, and their results are pickled, too."""

import pickle
from concurrent.futures import Executor, Future


class Inline(Executor):
    """Runs what it is given in this process, as if it were another one.

    Args:
        processes: that it pretends to have.
    """

    def __init__(self, processes: int = 4):
        self._max_workers = processes

    def submit(self, function, /, *arguments):
        """Run a function of arguments that can be sent."""
        future = Future()
        future.set_running_or_notify_cancel()
        try:
            sent = pickle.loads(pickle.dumps((function, arguments)))
            future.set_result(pickle.loads(pickle.dumps(sent[0](*sent[1]))))
        except BaseException as error:
            future.set_exception(error)
        return future
