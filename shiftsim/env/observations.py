"""What an observation is: a space, and how it is filled from an episode."""

from typing import Any, Protocol

from gymnasium import Space, spaces

from shiftsim.env.episode import Episode


class Observer(Protocol):
    """Makes observations; one's own is given to the environment as an object with these three."""

    space: Space[Any]  # of what `look` returns

    def start(self, episode: Episode) -> None:
        """Prepare for a new episode."""

    def look(self, episode: Episode) -> Any:
        """The present observation, in arrays that nobody writes to later."""


class Nothing:
    """No observation, for policies that need none."""

    space: Space[Any] = spaces.Discrete(1)

    def start(self, episode: Episode) -> None:
        """Nothing to prepare."""

    def look(self, episode: Episode) -> int:
        """Always the same."""
        return 0
