"""What other threads ask of the control loop."""

from collections.abc import Callable
from concurrent.futures import Future

from hardware_agent.senses import Senses
from hardware_agent.status import Refused


class Request:
    """Something to be done between two ticks, unless whoever asked has given up by then.

    Args:
      act: does it.
    """

    def __init__(self, act: Callable[[Senses], Refused | None]) -> None:
        self._act = act
        self._answer: Future[Refused | None] = Future()

    def run(self, senses: Senses) -> None:
        """Do it, from the control loop; one that was given up is never done."""
        if not self._answer.set_running_or_notify_cancel():
            return
        try:
            self._answer.set_result(self._act(senses))
        except BaseException as error:
            self._answer.set_exception(error)
            raise

    def refuse(self, refused: Refused) -> None:
        """Answer that it is not done."""
        if self._answer.set_running_or_notify_cancel():
            self._answer.set_result(refused)

    def wait(self, patience: float, late: Refused) -> Refused | None:
        """The answer.

        Args:
          patience: after which it is given up where it has not begun, s.
          late: what is answered then.
        """
        try:
            return self._answer.result(patience)
        except TimeoutError:
            return late if self._answer.cancel() else self._answer.result()
