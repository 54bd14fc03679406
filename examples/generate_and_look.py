"""Generate a small dataset of two camera sites, look at it, and load it as PyTorch does.

    python examples/generate_and_look.py OUT

Takes about a minute on a laptop; call it again and it says the same at once.
"""

import sys
from collections import Counter
from pathlib import Path

from torch.utils.data import DataLoader

import skope
from skope import draw


def main(out: Path) -> None:
    dataset = skope.generate(out, sites=["t01_mill_corner", "t05_market_first"], frames=3, size="640x360")
    for labelled in dataset:
        vehicles = [one for one in labelled.annotations if not one.ignored]
        kinds = Counter(one.vehicle_type for one in vehicles)
        print(f"{labelled.record.file_name}: {', '.join(f'{n} {kind}' for kind, n in kinds.most_common()) or 'nobody'}")
        picture = draw.annotations(labelled.pixels(), vehicles, scheme=dataset.scheme)
        name = f"{labelled.record.site}_{labelled.record.frame_index}.jpg"
        draw.write(out.with_name(f"{out.name}_seen") / name, picture)

    split = dataset.splits[0]
    for batch in DataLoader(skope.torch_dataset(out, split), batch_size=2, collate_fn=list):
        vehicles = sum(len(target["boxes"]) for _, target in batch)
        print(f"{split}: a batch of {len(batch)} images with {vehicles} vehicles")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
