from collections import Counter
from itertools import pairwise

from skope.gen.pipeline.workers import Backlog
from skope.gen.scene.recording import Take

TAKES = [Take(f"t0{town}_{site}", "00", "train", 20) for town in range(1, 5) for site in "abcd"]


def test_hands_spread_and_each_goes_on_from_its_last_take() -> None:
    backlog = Backlog({take: list(range(take.frames)) for take in TAKES})
    holding: dict[int, Take | None] = dict.fromkeys(range(4))
    taken: dict[int, list[Take]] = {hand: [] for hand in holding}
    done: Counter[tuple[Take, int]] = Counter()
    while backlog:
        for hand in holding:
            if backlog:
                job = backlog.next_for(holding[hand])
                holding[hand] = job.take
                done.update((job.take, frame) for frame in job.frames)
                if job.take not in taken[hand]:
                    taken[hand].append(job.take)
    assert done == {(take, frame): 1 for take in TAKES for frame in range(20)}
    first = [TAKES.index(takes[0]) for takes in taken.values()]
    assert first == [0, 8, 4, 12]
    for takes in taken.values():
        assert [TAKES.index(b) - TAKES.index(a) for a, b in pairwise(takes)] == [1, 1, 1]


def test_one_hand_goes_through_all_in_order() -> None:
    backlog, take, met = Backlog({take: [0, 9] for take in TAKES}), None, list[Take]()
    while backlog:
        take = backlog.next_for(take).take
        met.append(take)
    assert met == TAKES


def test_a_lost_job_is_done_by_another() -> None:
    backlog = Backlog({TAKES[0]: [0, 1], TAKES[1]: [5]})
    job, other = backlog.next_for(None), backlog.next_for(None)
    assert not backlog
    backlog.put_back(job)
    assert backlog.next_for(other.take) == job
    assert not backlog
