"""What every network must do, whatever it is for."""

import pytest
import torch
from tensordict import TensorDict

from ifo_grounding.data import first_frame_buffer, record_demonstrations, show_codes
from ifo_grounding.envs import PickAndPlaceEnv
from ifo_grounding.errors import UserError
from ifo_grounding.mosaic import as_words, assemble
from ifo_grounding.networks import NetworkConfig, Shapes, read_codes
from networks.conftest import MAKERS, OUTPUTS, inputs, nested_keys, tiled

SIZES = [
    Shapes((3, 96, 96), 40, tile_size=16),
    Shapes((1, 30, 21), 7, instruction_length=5, n_actions=3),
]


def run(kind, module, data):
    key, size = OUTPUTS[kind]
    own = data.select(*module.in_keys)
    return module(own)[key], size


@pytest.mark.parametrize("sizes", SIZES, ids=str)
def test_other_images_vocabularies_lengths_and_action_counts_work(kind, preset, sizes):
    module = MAKERS[kind](sizes, preset, seed=0)
    out, size = run(kind, module, inputs(sizes, [3]))
    assert out.shape == (3, sizes.n_actions if size == "A" else size)
    assert out.dtype == torch.float32
    assert out.isfinite().all()


@pytest.mark.parametrize("batch", [[], [0], [2, 1, 2]], ids=str)
def test_any_leading_dims_give_what_one_dim_gives(kind, preset, shapes, batch):
    module = MAKERS[kind](shapes, preset, seed=0)
    data = inputs(shapes, batch)
    out, _ = run(kind, module, data)
    flat = data.reshape(data.batch_size.numel()) if batch else data.unsqueeze(0)
    expected, _ = run(kind, module, flat)
    assert out.shape[:-1] == tuple(batch)
    torch.testing.assert_close(out.reshape(expected.shape), expected)


def test_samples_do_not_see_each_other(kind, preset, shapes):
    module = MAKERS[kind](shapes, preset, seed=0)
    data = inputs(shapes, [6])
    out, _ = run(kind, module, data)
    order = torch.tensor([5, 0, 3, 1, 4, 2])
    torch.testing.assert_close(run(kind, module, data[order])[0], out[order])


def test_every_input_matters(kind, preset, shapes):
    module = MAKERS[kind](shapes, preset, seed=0)
    data = inputs(shapes, [4])
    out, _ = run(kind, module, data)
    other = inputs(shapes, [4], seed=1)
    other["action"] = (data["action"] + 1) % 6
    for key in module.in_keys:
        changed = data.clone().set(key, other[key])
        assert (run(kind, module, changed)[0] != out).any(-1).all(), key


def test_the_seed_alone_decides_the_weights_and_the_global_generator_stays(kind, shapes):
    torch.manual_seed(1)
    before = torch.get_rng_state()
    first = MAKERS[kind](shapes, seed=3)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    second, third = MAKERS[kind](shapes, seed=3), MAKERS[kind](shapes, seed=4)
    assert all(map(torch.equal, first.parameters(), second.parameters()))
    assert not all(map(torch.equal, first.parameters(), third.parameters()))


def test_networks_come_in_eval_mode_and_repeat_themselves(kind, preset, shapes):
    module = MAKERS[kind](shapes, preset, seed=0)
    assert not any(part.training for part in module.modules())
    data = inputs(shapes, [3])
    assert torch.equal(run(kind, module, data)[0], run(kind, module, data)[0])


def test_the_paper_has_dropout_but_no_critic_does(kind, shapes):
    module = MAKERS[kind](shapes, "paper", seed=0).train()
    data = inputs(shapes, [3])
    repeats = torch.equal(run(kind, module, data)[0], run(kind, module, data)[0])
    assert repeats == (kind == "value")


@pytest.mark.parametrize("alike", [True, False])
def test_floats_are_bytes_over_255_of_which_those_that_repeat_are_read_once(
    kind, preset, shapes, alike
):
    module = MAKERS[kind](shapes, preset, seed=0)
    data = inputs(shapes, [40 if alike else 3])
    if alike:
        data["pixels"], data["initial_pixels"], data["next", "pixels"] = tiled(120).split(40)
    floats = data.apply(lambda x: x / 255 if x.dtype == torch.uint8 else x)
    found = [outputs_and_gradients(module, kind, each) for each in (data, floats)]
    torch.testing.assert_close(*found, atol=1e-3, rtol=1e-3)


def outputs_and_gradients(module, kind, data):
    module.zero_grad()
    out, _ = run(kind, module, data)
    (out * torch.linspace(-1, 1, out.numel()).view_as(out)).sum().backward()
    return [out.detach(), *(parameter.grad.clone() for parameter in module.parameters())]


@pytest.mark.parametrize("tile", [8, 16])
def test_numbers_of_tiles_are_read_as_the_pixels_that_they_stand_for(kind, preset, shapes, tile):
    module, data = MAKERS[kind](shapes, preset, seed=0), inputs(shapes, [40])
    draw = torch.Generator().manual_seed(0)
    tiles = torch.randint(256, (9, 3, tile, tile), generator=draw, dtype=torch.uint8)
    coded = data.clone()
    for key in ("pixels", "initial_pixels", ("next", "pixels")):
        codes = torch.randint(9, (40, 48 // tile, 48 // tile), generator=draw, dtype=torch.int16)
        coded[key], data[key] = codes, assemble(as_words(tiles), codes)
    read_codes(module, tiles)
    found = [outputs_and_gradients(module, kind, each) for each in (data, coded)]
    torch.testing.assert_close(*found, atol=1e-5, rtol=1e-4)
    shaped = coded.reshape(5, 8)
    assert run(kind, module, shaped)[0].shape[:2] == (5, 8)
    assert not any("tiles" in name for name in module.state_dict())


def test_numbers_of_tiles_that_a_network_does_not_know_are_refused(kind, shapes):
    env = PickAndPlaceEnv(num_envs=2, seed=0, codes=True)
    module, data = MAKERS[kind](shapes, seed=0), inputs(shapes, [2])
    data["initial_pixels"] = data["pixels"] = data["next", "pixels"] = env.reset()["pixels"]
    with pytest.raises(UserError, match=r"got numbers of tiles: .*read_codes\(network, env.tiles"):
        run(kind, module, data)
    read_codes(module, env.tiles)
    for key in ("pixels", "initial_pixels", ("next", "pixels")):
        data[key] = data[key][:, 1:]
    with pytest.raises(UserError, match="images of 48 x 48 pixels, got 5 x 6 tiles of 8"):
        run(kind, module, data)
    read_codes(module, env.tiles[:3])
    with pytest.raises(UserError, match=r"hold tile \d+: allowed are 0\.\.2"):
        run(kind, module, data)


def test_what_are_no_tiles_of_a_network_is_refused(shapes):
    policy, tiles = MAKERS["policy"](shapes, seed=0), PickAndPlaceEnv(codes=True).tiles
    buffer = first_frame_buffer(record_demonstrations("move", 2, seed=0))
    for wrong in (PickAndPlaceEnv().tiles, tiles.float(), tiles[0], tiles[..., :4]):
        with pytest.raises(UserError, match=r"tiles are uint8 \[K, C, T, T\]"):
            read_codes(policy, wrong)
        with pytest.raises(UserError, match=r"tiles are uint8 \[K, C, T, T\]"):
            show_codes(buffer, wrong)
    with pytest.raises(UserError, match="at most 32,768 tiles"):
        read_codes(policy, tiles[:1].expand(1 << 16, -1, -1, -1))
    with pytest.raises(UserError, match="1 channels, and images for this network 3"):
        read_codes(policy, tiles[:, :1])
    with pytest.raises(UserError, match="Linear holds no network"):
        read_codes(torch.nn.Linear(1, 1), tiles)


def test_keys_can_be_nested(kind, shapes):
    plain = MAKERS[kind](shapes, seed=0)
    keys = nested_keys(plain)
    nested = MAKERS[kind](shapes, seed=0, **keys)
    data = inputs(shapes, [3])
    moved = TensorDict({"agent": data.clone()}, [3])
    out = nested(moved.select(*nested.in_keys))
    expected, _ = run(kind, plain, data)
    assert torch.equal(out[keys.get("out_key", ("agent", "scores"))], expected)
    if kind == "policy":
        assert out["agent", "choice"].dtype == torch.int64
        assert out["agent", "choice_log_prob"].shape == (3,)


def test_wrong_images_batches_and_options_are_named(kind, shapes):
    module = MAKERS[kind](shapes, seed=0)
    small = inputs(Shapes((3, 40, 48), 40), [2])
    with pytest.raises(UserError, match=r"built for images of \(3, 48, 48\), got \(3, 40, 48\)"):
        run(kind, module, small)
    with pytest.raises(UserError, match="unknown preset 'film': choose one of 'paper', 'strong'"):
        MAKERS[kind](shapes, "film")
    with pytest.raises(UserError, match="unknown option of a network 'depth'"):
        MAKERS[kind](shapes, depth=3)
    with pytest.raises(UserError, match="in_keys must be"):
        MAKERS[kind](shapes, in_keys=["pixels"])


def test_inputs_of_different_batches_are_refused(kind, shapes):
    module, data = MAKERS[kind](shapes, seed=0), inputs(shapes, [4])
    network = module.module[0].module if kind == "policy" else module.module
    *others, last = (data[key] for key in module.in_keys)
    with pytest.raises(UserError, match=r"same batch dims, got .*\[4\], .*\[1\]"):
        network(*others, last[:1])


@pytest.mark.parametrize(
    ("preset", "options", "said"),
    [
        ("paper", {"conv_layers": 0}, "conv_layers must be at least 1, got 0"),
        ("strong", {"patch_size": 0}, "patch_size must be at least 1, got 0"),
        ("strong", {"context": -1}, "context must be at least 0, got -1"),
        ("strong", {"hidden": 1.5}, "hidden must be a whole number, got 1.5"),
        ("strong", {"dropout": 1.0}, "dropout must be below 1, got 1.0"),
        ("strong", {"head_hidden": (8, 0)}, r"head_hidden must be 1..65536, got \(8, 0\)"),
        ("strong", {"sentence_rate": 0.5}, "an option of preset 'paper' alone.*leave it out"),
        ("paper", {"heads": 4}, "an option of preset 'strong' alone.*leave it out"),
        ("paper", {"sentence_pooling": "max"}, "unknown sentence_pooling 'max'"),
    ],
)
def test_sizes_that_make_no_network_are_refused(preset, options, said):
    with pytest.raises(UserError, match=said):
        NetworkConfig.of("policy", preset, **options)


def test_presets_are_what_the_design_says():
    paper = NetworkConfig.of("policy", "paper")
    assert (paper.conv_layers, paper.features, paper.hidden, paper.embedding) == (4, 32, 64, 8)
    assert (paper.dropout, NetworkConfig.of("policy").preset) == (0.25, "strong")


def test_precision_is_the_callers(kind, preset, shapes):
    data, network = inputs(shapes, [4]), MAKERS[kind](shapes, preset, seed=0)
    exact, _ = run(kind, network, data)
    with torch.autocast("cpu", torch.bfloat16):
        rough, _ = run(kind, network, data)
    assert rough.dtype == torch.float32
    assert not torch.equal(rough, exact)
    torch.testing.assert_close(rough, exact, atol=0.03, rtol=0.05)


@pytest.mark.parametrize(
    ("precision", "off", "alike", "image"),  # cells that repeat are seen once
    [(torch.float64, 1e-4, True, torch.uint8), (torch.bfloat16, 0.1, False, torch.float32)],
)
def test_networks_of_another_precision_read_all_images(
    kind, preset, shapes, precision, off, alike, image
):
    data = inputs(shapes, [8])
    for name in ("pixels", "initial_pixels", ("next", "pixels")):
        pixels = data[name][..., :1, :1].expand_as(data[name]) if alike else data[name]
        data[name] = pixels.clone() if image == torch.uint8 else pixels / 255
    network = MAKERS[kind](shapes, preset, seed=0)
    expected, _ = run(kind, network, data)
    found = run(kind, network.to(precision), data)[0].float()
    torch.testing.assert_close(found, expected, atol=off, rtol=off)
