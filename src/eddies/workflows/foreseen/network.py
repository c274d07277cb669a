"""The cluster that a job on more ranks than are at hand is imagined on, and what messages take there."""

from __future__ import annotations

import math
from dataclasses import dataclass

NODE_CORES = 64              # cores of a node, each a rank or a thread of one
NODE_BANDWIDTH = 10e9        # bytes a second into and out of a node while all nodes talk to all: 100 Gbit/s, not quite
RANK_BANDWIDTH = 2e9         # bytes a second of a rank to others of its node, where one rank at hand cannot tell
LATENCY = 2e-6               # seconds of a message


@dataclass(frozen=True)
class Network:
    """So many ranks of `threads` threads, side by side on nodes of NODE_CORES cores; within a node a rank sends
    `bandwidth` bytes a second. One rank sends nothing."""

    ranks: int
    bandwidth: float
    threads: int = 1

    @property
    def on_node(self) -> int:
        """Ranks of a node."""
        return min(self.ranks, max(NODE_CORES // self.threads, 1))

    @property
    def nodes(self) -> int:
        """Nodes that they fill."""
        return math.ceil(self.ranks / self.on_node)

    def all_to_all(self, size: float, times: float = 1) -> float:
        """Seconds in which all ranks exchange `size` bytes in all, what stays with its rank included, in so many
        rounds of messages from each rank to every other."""
        if self.ranks == 1:
            return 0.0
        own = size / self.ranks
        within = own * (self.on_node - 1) / self.ranks / self.bandwidth
        beyond = own * (self.ranks - self.on_node) / self.ranks * self.on_node / NODE_BANDWIDTH
        return within + beyond + times * (self.ranks - 1) * LATENCY

    def to_neighbors(self, size: float, messages: float) -> float:
        """Seconds in which each rank sends `size` bytes to each of the two beside it, in so many messages; the first
        and the last rank of a node have one of them on another."""
        if self.ranks == 1:
            return 0.0
        outside = 0 if self.nodes == 1 else 2 if self.on_node == 1 else 1
        return size * ((2 - outside) / self.bandwidth + outside / NODE_BANDWIDTH) + messages * LATENCY

    def sum_over_ranks(self, times: float) -> float:
        """Seconds of so many sums of a few numbers over all ranks, there and back along a tree."""
        return times * 2 * math.ceil(math.log2(self.ranks)) * LATENCY
