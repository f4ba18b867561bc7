import torch

from cconv.neighbors import radius_graph
from cconv.nn import ConvGeometry


def test_edges_by_sender_are_all_edges_in_that_order(generator):
    points, queries = (torch.rand(count, 2, generator=generator) for count in (30, 20))
    reads = ConvGeometry(radius_graph(points, 0.3, queries=queries), 3).reads
    splits, order = reads.by_sender
    assert torch.equal(order, reads.senders.argsort(stable=True).int())
    for sender in range(30):
        edges = order[splits[sender] : splits[sender + 1]]
        assert (reads.senders[edges] == sender).all()


def test_corner_weights_sum_to_the_weight_of_the_edge(generator):
    for interpolation in ("linear", "nearest_neighbor", "linear_border"):
        edges = radius_graph(torch.rand(30, 3, generator=generator), 0.4)
        reads = ConvGeometry(edges, (2, 3, 4), "identity", interpolation=interpolation, align_corners=False).reads
        cells, weights = zip(*reads.corners(), strict=True)
        torch.testing.assert_close(sum(weights), reads.weights)
        assert min(corner.min() for corner in cells) >= 0
        assert max(corner.max() for corner in cells) < reads.num_cells
