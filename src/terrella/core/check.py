"""check_world: tests any World against the contract."""

import random
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces

from .errors import ActionError, ChannelError, ContractError, ObservationError, StaleStateError, TerrellaError
from .spec import AXES, BUTTONS, MODES, Spec, dtype_of, kind_of, shape_of
from .state import State
from .world import Observation, World, make_rng

# Kinds of channels with a fixed meaning: dtype, and number of axes of one entry.
_WELL_KNOWN = {
    "rgb": (np.uint8, 3), "depth": (np.float32, 2), "pose": (np.float32, 1), "reward": (np.float32, 0),
    "done": (np.bool_, 0), "known": (np.float32, 2), "places": (np.float32, 2), "mosaic": (np.uint8, 3),
    "text": (np.uint8, 1), "instruction": (np.float32, 1),
}  # fmt: skip


def check_world(world: World, seed: int = 0, steps: int = 3) -> list[str]:
    """Tests every law of the contract; returns their names, or raises ContractError at the first that fails.

    The tests start several episodes, so states that were made before are stale afterwards where the world cannot fork.
    `steps` is the length of an episode; laws about `done` are tested only where an episode ends within it.
    """
    if not isinstance(world, World) or not isinstance(world.spec, Spec):
        raise ContractError("a World has `spec` (a terrella.Spec) and the verbs start, observe, imagine, render.")
    laws = [
        _spec_is_valid, _starts_and_renders, _refuses_other_batches, _acts_deterministically, _refuses_junk,
        _observes,
    ]  # fmt: skip
    if world.spec.differentiable:
        laws.append(_gradients_reach_the_action)
    if world.spec.forkable:
        laws += [_states_are_values, _states_can_be_saved, _forks_and_puts, _batches, _a_batch_equals_its_singles]
    else:
        laws += [*[_batches] * (world.spec.max_batch != 1), _stale_states_are_refused]
    for law in laws:
        with torch.set_grad_enabled(law is _gradients_reach_the_action):
            law(world, seed, steps)
    return [law.__name__.strip("_") for law in laws]


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ContractError(message)


def _require_raises(error: type[Exception], message: str, verb, *args) -> None:
    try:
        verb(*args)
    except error:
        return
    except Exception as other:
        raise ContractError(f"{message} It raised {type(other).__name__}: {other}") from other
    raise ContractError(message)


def _same(a: Observation, b: Observation) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def _copy(tensors: Observation) -> Observation:
    return {name: tensor.clone() for name, tensor in tensors.items()}


def _check_observation(world: World, seen: Observation, channels: Sequence[str], batch: int) -> None:
    _require(set(seen) == set(channels), f"render was asked for {sorted(channels)} and gave {sorted(seen)}.")
    for name in channels:
        space, tensor = world.spec.channels[name], seen[name]
        _require(isinstance(tensor, torch.Tensor), f"channel '{name}' is not a tensor.")
        want = (batch, *shape_of(space))
        _require(tuple(tensor.shape) == want, f"channel '{name}' has shape {tuple(tensor.shape)}, not {want}.")
        rows = tensor.cpu().numpy()
        _require(rows.dtype == space.dtype, f"channel '{name}' is {rows.dtype}, its spec says {space.dtype}.")
        _require(all(space.contains(np.asarray(row)) for row in rows), f"channel '{name}' leaves its space {space}.")
    for name in channels:
        if kind_of(name) == "pose":
            lengths = seen[name][:, 3:].norm(dim=1)
            _require(bool((lengths - 1).abs().max() < 1e-3), f"the quaternion of channel '{name}' must have length 1.")


def _spec_is_valid(world: World, seed: int, steps: int) -> None:
    spec = world.spec
    _require(0 < spec.dt_s < float("inf"), "spec.dt_s must be positive seconds.")
    _require(bool(spec.channels), "a world renders at least one channel.")
    for name, space in spec.channels.items():
        dtype, axes = _WELL_KNOWN.get(kind_of(name), (None, 0))
        fits = dtype is None or (dtype_of(space) == dtype and len(shape_of(space)) == axes)
        _require(fits, f"channel '{name}' must be {np.dtype(dtype)} of {axes} axes, without the batch; it is {space}.")
    for what, names in (("observes", spec.observes), ("may_observe", spec.may_observe), ("units", spec.units)):
        strangers = sorted(set(names) - set(spec.channels))
        _require(not strangers, f"spec.{what} names {strangers}, which are not among spec.channels.")
    twice = sorted(set(spec.observes) & set(spec.may_observe))
    _require(not twice, f"spec.may_observe names {twice}, which spec.observes names already.")
    _require(spec.max_batch is None or spec.max_batch >= 1, "spec.max_batch is None or at least 1.")
    _cameras_are_valid(spec)
    _actions_have_a_meaning(spec)


def _cameras_are_valid(spec: Spec) -> None:
    for name, camera in spec.cameras.items():
        pictures = name in spec.channels and kind_of(name) == "rgb"
        _require(pictures, f"spec.cameras names '{name}', which is no picture channel (rgb, rgb.wrist) of this world.")
        valid = len(camera.intrinsics) == 4 and min(camera.intrinsics) > 0
        _require(valid, f"the intrinsics of camera '{name}' are four positive numbers: fx/W, fy/H, cx/W, cy/H.")
        size = shape_of(spec.channels[name])[:2]
        _require(tuple(camera.size) == size, f"camera '{name}' has size {camera.size}, its pictures have {size}.")
        mounted = camera.pose is None or (camera.pose in spec.channels and kind_of(camera.pose) == "pose")
        _require(mounted, f"camera '{name}' is mounted on '{camera.pose}', which is no pose channel of this world.")
        unit = len(camera.mount) == 7 and abs(float(np.linalg.norm(camera.mount[3:])) - 1) < 1e-3
        _require(unit, f"the mount of camera '{name}' is x, y, z and a quaternion w, x, y, z of length 1.")


def _actions_have_a_meaning(spec: Spec) -> None:
    axes, width = isinstance(spec.action, spaces.Box), int(np.prod(shape_of(spec.action)))
    _require(spec.action_mode in MODES, f"spec.action_mode is '{spec.action_mode}'; it must be one of {MODES}.")
    fits = spec.action_mode in AXES if axes else spec.action_mode not in AXES
    fits = fits and (spec.action_mode != BUTTONS or isinstance(spec.action, spaces.MultiBinary))
    _require(fits, f"spec.action_mode is '{spec.action_mode}', which the action space {spec.action} cannot be.")
    if spec.action_units:
        count = len(spec.action_units)
        _require(axes and count == width, f"spec.action_units has {count} units; the space {spec.action} has {width}.")
    if spec.action_names:
        count = int(spec.action.n) if isinstance(spec.action, spaces.Discrete) else width
        _require(
            len(spec.action_names) == count,
            f"spec.action_names has {len(spec.action_names)} names for {count} actions.",
        )
    for key, flat in spec.keys.items():
        try:
            spec.check_action(torch.tensor(flat).reshape(1, *shape_of(spec.action)), 1)
        except (ActionError, RuntimeError, TypeError, ValueError) as error:
            raise ContractError(f"key '{key}' stands for {flat}, which is no action: {error}") from error


def _starts_and_renders(world: World, seed: int, steps: int) -> None:
    channels = tuple(world.spec.channels)
    state = world.start(1, make_rng(seed))
    _require(isinstance(state, State) and state.batch == 1, "start(1, rng) gives a State with batch 1.")
    together = _copy(world.render(state, channels))
    _check_observation(world, together, channels, 1)
    for name in channels:
        alone = world.render(state, (name,))
        _check_observation(world, alone, (name,), 1)
        _require(
            torch.equal(alone[name], together[name]),
            f"channel '{name}' rendered alone differs from it rendered with others.",
        )
    _require(not world.render(state, ()), "render of no channels must give no channels.")
    _require_raises(
        ChannelError, "render of an unknown channel must raise ChannelError.", world.render, state, ("no such channel",)
    )


def _refuses_other_batches(world: World, seed: int, steps: int) -> None:
    rng, most = make_rng(seed), world.spec.max_batch
    _require_raises(TerrellaError, "start(0, rng) must raise a TerrellaError.", world.start, 0, rng)
    if most is not None:
        message = f"start({most + 1}, rng) must raise a TerrellaError, for spec.max_batch is {most}."
        _require_raises(TerrellaError, message, world.start, most + 1, rng)


def _episode(world: World, seed: int, steps: int) -> list[Observation]:
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    state = world.start(1, rng)
    frames = [_copy(world.render(state, channels))]
    for _ in range(steps):
        state = world.imagine(state, world.spec.sample_action(1, rng), rng)
        _require(isinstance(state, State) and state.batch == 1, "imagine gives a State of the batch that it was given.")
        frames.append(_copy(world.render(state, channels)))
        _check_observation(world, frames[-1], channels, 1)
    return frames


def _global_chance() -> tuple:
    """The states of the global generators of torch, numpy and Python."""
    numpy_state = np.random.get_state(legacy=True)
    return torch.get_rng_state().tolist(), [np.asarray(part).tolist() for part in numpy_state], random.getstate()


def _acts_deterministically(world: World, seed: int, steps: int) -> None:
    _ = torch.rand(1), np.random.random(), random.random()  # advances them, so that seeding one again is noticed
    chance = _global_chance()
    first, second = _episode(world, seed, steps), _episode(world, seed, steps)
    _require(all(_same(a, b) for a, b in zip(first, second, strict=True)), "the same seed must give the same episode.")
    _require(chance == _global_chance(), "chance must come from the rng alone, not from global generators.")
    for now, then in zip(first, first[1:]):
        if "done" in now and bool(now["done"]):
            paid = float(then["reward"]) if "reward" in then else 0.0
            _require(bool(then["done"]), "an episode that is done must stay done.")
            _require(paid == 0, "an episode that is done must give no more reward.")


def _refuses_junk(world: World, seed: int, steps: int) -> None:
    rng = make_rng(seed)
    state = world.start(1, rng)
    good = world.spec.sample_action(1, rng)
    junk = [good[None], torch.cat([good, good]), torch.full(good.shape, float("nan")), "forward"]
    low, high = world.spec.action_limits
    if np.isfinite(high).all():
        junk.append(torch.from_numpy(np.broadcast_to(high.astype(np.float64) + 1, good.shape).copy()))
    if high.dtype.kind != "f":
        junk.append(good.double() + 0.5)
    for action in junk:
        message = f"imagine must raise ActionError for the action {action!r}."
        _require_raises(ActionError, message, world.imagine, state, action, rng)
    world.imagine(state, good, rng)


def _observes(world: World, seed: int, steps: int) -> None:
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    for names in dict.fromkeys((world.spec.observes, (*world.spec.observes, *world.spec.may_observe))):
        state = world.start(1, rng)
        held = _copy(state)
        seen = _copy(world.render(state, names))
        for prior in (state, None):
            posterior = world.observe(seen, prior, rng)
            _require(isinstance(posterior, State) and posterior.batch == 1, "observe gives a State of the same batch.")
            _check_observation(world, world.render(posterior, channels), channels, 1)
            _require(_same(held, state), "observe must leave the prior that it was given unchanged.")
    if world.spec.observes:
        message = f"observe without {', '.join(world.spec.observes)} must raise ObservationError."
        _require_raises(ObservationError, message, world.observe, {}, None, rng)


def _states_are_values(world: World, seed: int, steps: int) -> None:
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    state = world.start(1, rng)
    held, before = _copy(state), _copy(world.render(state, channels))
    action = world.spec.sample_action(1, rng)
    branch = world.imagine(state, action, make_rng(seed + 1))
    expected = _copy(world.render(branch, channels))
    ahead = branch
    for _ in range(steps):
        ahead = world.imagine(ahead, world.spec.sample_action(1, rng), rng)
    unchanged = _same(held, state) and _same(before, world.render(state, channels))
    _require(unchanged, "imagine must leave the state that it was given unchanged.")
    again = world.imagine(state, action, make_rng(seed + 1))
    _require(_same(expected, world.render(again, channels)), "a state must be able to branch twice alike.")


def _states_can_be_saved(world: World, seed: int, steps: int) -> None:
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    state = world.imagine(world.start(1, rng), world.spec.sample_action(1, rng), rng)
    before = _copy(world.render(state, channels))
    with tempfile.TemporaryDirectory() as folder:
        state.save(Path(folder) / "state.safetensors")
        action = world.spec.sample_action(1, rng)
        expected = _copy(world.render(world.imagine(state, action, make_rng(seed + 1)), channels))
        world.start(1, make_rng(seed + 2))  # a world that keeps data outside of the State has lost it now
        restored = State.load(Path(folder) / "state.safetensors").to(next(iter(state.values())).device)
    _require(_same(before, world.render(restored, channels)), "a saved and restored state must render the same.")
    after = world.imagine(restored, action, make_rng(seed + 1))
    _require(_same(expected, world.render(after, channels)), "a restored state must go on as the original.")


def _batches(world: World, seed: int, steps: int) -> None:
    if world.spec.max_batch == 1:
        return
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    states = world.start(2, rng)
    _require(isinstance(states, State) and states.batch == 2, "start(2, rng) gives a State with batch 2.")
    states = world.imagine(states, world.spec.sample_action(2, rng), rng)
    _require(isinstance(states, State) and states.batch == 2, "imagine gives a State of the batch that it was given.")
    seen = _copy(world.render(states, channels))
    _check_observation(world, seen, channels, 2)
    for entry in range(2):
        alone = world.render(states.at(entry), channels)
        for name in channels:
            alike = _close(alone[name], seen[name][entry : entry + 1])
            _require(alike, f"channel '{name}' of a batch entry depends on its neighbour.")
    turned = world.imagine(states.at([1, 0]), world.spec.sample_action(2, rng), rng)
    _check_observation(world, world.render(turned, channels), channels, 2)


def _close(one: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether two tensors are equal up to rounding, as of sums in another order."""
    slack = 1.01 if one.dtype == torch.uint8 else 1e-3
    return torch.allclose(one.double(), other.double(), rtol=1e-3, atol=slack)


def _a_batch_equals_its_singles(world: World, seed: int, steps: int) -> None:
    if world.spec.max_batch == 1:
        return
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    states, actions = world.start(2, rng), world.spec.sample_action(2, rng)
    together = _copy(world.render(world.imagine(states, actions, make_rng(seed + 1)), channels))
    one_rng = make_rng(seed + 1)
    for entry in range(2):
        alone = world.render(world.imagine(states.at(entry), actions[entry : entry + 1], one_rng), channels)
        for name in channels:
            message = f"channel '{name}' of a batch differs from that of single episodes stepped one after the other."
            _require(_close(alone[name], together[name][entry : entry + 1]), message)


def _forks_and_puts(world: World, seed: int, steps: int) -> None:
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    state = world.imagine(world.start(1, rng), world.spec.sample_action(1, rng), rng)
    before = _copy(world.render(state, channels))
    if world.spec.max_batch is not None and world.spec.max_batch < 2:
        return
    forked = state.fork(2)
    _require(forked.batch == 2, "fork(2) of one state has batch 2.")
    fresh = world.start(1, rng)
    begun = _copy(world.render(fresh, channels))
    mixed = forked.put(torch.tensor([1]), fresh)
    for entry, expected in ((0, before), (1, begun)):
        seen = world.render(mixed.at(entry), channels)
        _require(all(_close(seen[name], expected[name]) for name in channels), "put changes the named entries alone.")
    seen = world.render(forked.at(1), channels)
    _require(all(_close(seen[name], before[name]) for name in channels), "a fork renders as what it was forked from.")


def _gradients_reach_the_action(world: World, seed: int, steps: int) -> None:
    rng = make_rng(seed)
    state, action = world.start(1, rng), world.spec.sample_action(1, rng).float().requires_grad_()
    seen = world.render(world.imagine(state, action, rng), tuple(world.spec.channels))
    sums = [tensor.sum() for tensor in seen.values() if tensor.requires_grad]
    message = "spec.differentiable is True, but no gradient reaches the action from any channel."
    _require(bool(sums), message)
    (gradient,) = torch.autograd.grad(torch.stack(sums).sum(), action, allow_unused=True)
    _require(gradient is not None and bool(torch.isfinite(gradient).all()) and bool((gradient != 0).any()), message)


def _stale_states_are_refused(world: World, seed: int, steps: int) -> None:
    rng, channels = make_rng(seed), tuple(world.spec.channels)
    action = world.spec.sample_action(1, rng)
    left = world.start(1, rng)
    world.imagine(left, action, rng)
    ended = world.start(1, rng)
    world.start(1, rng)
    for stale in (left, ended) if world.spec.max_batch == 1 else (left,):
        message = "a world with forkable=False must raise StaleStateError for a state that it has left."
        _require_raises(StaleStateError, f"imagine: {message}", world.imagine, stale, action, rng)
        _require_raises(StaleStateError, f"render: {message}", world.render, stale, channels)
