from collections import Counter
from itertools import pairwise

from skope.gen.pipeline.workers import JobQueue
from skope.gen.scene.recording import RecordingInfo

RECORDINGS = [RecordingInfo(f"t0{town}_{site}", "00", "train", 20) for town in range(1, 5) for site in "abcd"]


def test_workers_spread_and_each_goes_on_from_its_last_recording() -> None:
    queue = JobQueue({recording: list(range(recording.frames)) for recording in RECORDINGS})
    holding: dict[int, RecordingInfo | None] = dict.fromkeys(range(4))
    taken: dict[int, list[RecordingInfo]] = {worker: [] for worker in holding}
    done: Counter[tuple[RecordingInfo, int]] = Counter()
    while queue:
        for worker in holding:
            if queue:
                job = queue.next_for(holding[worker])
                holding[worker] = job.recording
                done.update((job.recording, frame) for frame in job.frames)
                if job.recording not in taken[worker]:
                    taken[worker].append(job.recording)
    assert done == {(recording, frame): 1 for recording in RECORDINGS for frame in range(20)}
    first = [RECORDINGS.index(recordings[0]) for recordings in taken.values()]
    assert first == [0, 8, 4, 12]
    for recordings in taken.values():
        assert [RECORDINGS.index(b) - RECORDINGS.index(a) for a, b in pairwise(recordings)] == [1, 1, 1]


def test_workers_begin_with_different_towns_where_views_share_one() -> None:
    views = [RecordingInfo("t01_a", f"{number:02d}", "train", 20) for number in range(12)]
    queue, given = JobQueue({recording: [0] for recording in views}, views=4), list[int]()
    while queue:
        given.append(int(queue.next_for(None).recording.name))
    assert sorted(given[:3]) == [0, 4, 8]
    assert sorted(given) == list(range(12))


def test_the_views_of_a_town_are_shared_out_when_there_is_nothing_else() -> None:
    views = [RecordingInfo("t01_a", f"{number:02d}", "train", 20) for number in range(4)]
    queue = JobQueue({recording: list(range(20)) for recording in views}, views=4)
    assert [int(queue.next_for(None).recording.name) for _ in range(4)] == [0, 2, 1, 3]


def test_one_worker_goes_through_all_recordings_in_order() -> None:
    queue, recording, met = JobQueue({recording: [0, 9] for recording in RECORDINGS}), None, list[RecordingInfo]()
    while queue:
        recording = queue.next_for(recording).recording
        met.append(recording)
    assert met == RECORDINGS


def test_the_job_of_a_lost_worker_is_done_by_another() -> None:
    queue = JobQueue({RECORDINGS[0]: [0, 1], RECORDINGS[1]: [5]})
    job, other = queue.next_for(None), queue.next_for(None)
    assert not queue
    queue.put_back(job)
    assert queue.next_for(other.recording) == job
    assert not queue
