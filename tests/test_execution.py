"""Ways of running an update: which one is taken, what they sum up, and switches that are put back."""

from __future__ import annotations

import contextlib
import gc
import warnings
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch as th
from torch.nn import functional as F
from update_tools import all_tensors, largest_difference, needs_compiler, record_steps, to_float64

from sb3_dce import OfflineBC, OfflineDCE, Transitions
from sb3_dce.capture import CapturedStep, CaptureError, StaticInputs
from sb3_dce.errors import ConfigError, SB3DCEWarning
from sb3_dce.execution import UPDATES_WORTH_A_COMPILED_CALLER, choose_execution
from sb3_dce.metric_sums import MetricSums
from sb3_dce.precision import RoundedLinear, _warn_once, denormals_as_zero, matmul_precision, missing_for

CPU, CUDA = th.device("cpu"), th.device("cuda")


@pytest.mark.parametrize(
    ("execution", "planned", "device", "chosen"),
    [
        ("eager", 10**6, CPU, "eager"),
        ("auto", 10_000, CPU, "eager"),
        ("auto", 10_000, CUDA, "eager"),
        ("auto", 10_001, CUDA, "cudagraph"),
        ("cudagraph", 1, CUDA, "cudagraph"),
    ],
)
def test_execution_that_is_chosen(execution: str, planned: int, device: th.device, chosen: str) -> None:
    assert choose_execution(execution, planned, device) == chosen


@needs_compiler
def test_long_runs_are_compiled_on_a_processor() -> None:
    assert choose_execution("auto", 10_001, CPU) == "compile"
    with pytest.warns(SB3DCEWarning, match="CUDA device, this one is on cpu"):
        assert choose_execution("cudagraph", 1, CPU) == "compile"


@pytest.mark.parametrize("execution", ["compile", "cudagraph"])
def test_without_a_compiler_updates_are_not_compiled(execution: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.warns(SB3DCEWarning, match=f"{execution}.* needs a C"):
        assert choose_execution(execution, 10**6, CPU) == "eager"
    with pytest.warns(SB3DCEWarning, match="cudagraph.* needs a C.*: capturing the update as it is"):
        assert choose_execution("cudagraph", 10**6, CUDA) == "cudagraph"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert choose_execution("auto", 10**6, CPU) == "eager"
        assert choose_execution("auto", 10**6, CUDA) == "cudagraph"


@needs_compiler
def test_failing_compiler_is_no_reason_to_stop(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(function: Any, **options: Any) -> Any:
        def call(*arguments: Any) -> Any:
            raise RuntimeError("no such instruction")

        return call

    monkeypatch.setattr(th, "compile", broken)
    kwargs = {"dataset": transitions, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    eager, broken_model = (OfflineDCE("MlpPolicy", execution=e, **kwargs) for e in ("eager", "compile"))
    with pytest.warns(SB3DCEWarning, match="compiling the update failed, running eager: no such instruction") as caught:
        broken_model.learn(3)
    assert len([w for w in caught if "compiling" in str(w.message)]) == 1
    assert largest_difference(all_tensors(eager.learn(3)), all_tensors(broken_model)) == 0.0
    assert not broken_model._engine.is_compiled


@pytest.fixture
def captured_on_the_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands in for CUDA graphs: what they do is for ``test_gpu.py``, which of them there are is not."""

    class Step(CapturedStep):
        is_captured = False

        def __init__(self, step: Any, state: Any, draw: Any, coef: Any, metrics: Any, generator: Any = None) -> None:
            self._step, self._state, self._draw, self._coef = step, state, draw, dict(coef)
            self._metrics, self._generator = metrics, generator

        def replay(self) -> None:
            self._run()
            self._metrics.count(self._names)

    monkeypatch.setattr("sb3_dce.execution.CapturedStep", Step)
    monkeypatch.setattr("sb3_dce.base.choose_execution", lambda *_: "cudagraph")
    monkeypatch.setattr("sb3_dce.execution._has_compiler", lambda: False)


@pytest.mark.usefixtures("captured_on_the_processor")
def test_captured_updates_of_earlier_data_are_released(random_transitions: Callable[..., Transitions]) -> None:
    kwargs = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "seed": 0, "device": "cpu"}
    model = OfflineBC("MlpPolicy", dataset=random_transitions(100), **kwargs)
    for batch_size in (8, 12, 8):
        model.train(2, batch_size)
    captured = model._engine._captured
    assert len(captured) == 2, "both batch sizes stay"
    first = weakref.ref(next(iter(captured.values())))
    model.set_dataset(random_transitions(60))
    model.train(2, 8)
    gc.collect()
    assert len(captured) == 1 and first() is None
    assert not model._engine.is_compiled, "there was no compiler"


def test_metric_sums_average_over_the_updates_that_had_the_metric() -> None:
    sums = MetricSums()
    assert sums.read() == {}
    for n in range(4):
        metrics = {"a": th.tensor(float(n))}
        sums.add(metrics if n % 2 else {**metrics, "b": th.tensor(10.0 * n)})
    assert sums.read(clear=False) == {"a": 1.5, "b": 10.0}
    assert sums.read() == {"a": 1.5, "b": 10.0}
    assert sums.read() == {}
    sums.add({"a": th.tensor(7.0)})
    assert sums.read() == {"a": 7.0}


def test_metric_sums_keep_the_members_of_a_population_apart() -> None:
    sums = MetricSums()
    for n in range(2):
        sums.add({"a": th.tensor([1.0, 2.0]) * n, "b": th.tensor([0.0, 4.0])})
    means = sums.read_members()
    assert means["a"].tolist() == [0.5, 1.0] and means["b"].tolist() == [0.0, 4.0]


def test_metric_sums_stay_where_they_are() -> None:
    """A captured step adds to these tensors for ever."""
    sums = MetricSums()
    names = sums.accumulate({"a": th.tensor(1.0)})
    total = sums._totals[names]
    sums.count(names)
    sums.read()
    sums.add({"a": th.tensor(2.0)})
    assert sums._totals[names] is total and total.tolist() == [2.0]


def test_static_inputs_take_over_values_and_keep_their_place(
    transitions: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = record_steps(monkeypatch)
    OfflineDCE("MlpPolicy", dataset=transitions, batch_size=8, policy_kwargs={"net_arch": [8]}, seed=0).learn(2)
    first, second = recorded
    static = StaticInputs.like(first.batch, first.noise)
    place = static.batch.observations.data_ptr()
    assert place != first.batch.observations.data_ptr()
    static.fill(second.batch, second.noise)
    assert static.batch.observations.data_ptr() == place
    assert th.equal(static.batch.observations, second.batch.observations)
    assert th.equal(static.noise["actor"], second.noise["actor"])


def test_capture_is_on_the_models_device_and_its_failure_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """The calls of CUDA stand aside here; what they do is for ``test_gpu.py``."""
    places: list[Any] = []

    class Stream:
        def __init__(self, device: Any = None) -> None:
            places.append(device)

        def wait_stream(self, other: Any) -> None:
            pass

    @contextlib.contextmanager
    def at(place: Any) -> Iterator[None]:
        places.append(place)
        yield

    @contextlib.contextmanager
    def refusing(graph: Any, stream: Any) -> Iterator[None]:
        yield
        raise RuntimeError("operation not permitted when stream is capturing\nand more")

    for name, stand_in in {"Stream": Stream, "device": at, "graph": refusing, "CUDAGraph": object}.items():
        monkeypatch.setattr(th.cuda, name, stand_in)
    monkeypatch.setattr(th.cuda, "stream", lambda stream: contextlib.nullcontext())
    monkeypatch.setattr(th.cuda, "current_stream", Stream)
    weights, sums = th.zeros(2), MetricSums()

    def step(state: Any, batch: Any, noise: Any, coef: Any) -> dict[str, th.Tensor]:
        state["weights"] += batch
        return {"loss": th.ones(())}

    captured = CapturedStep(step, {"weights": weights}, lambda: (th.ones(2), {}), {}, sums)
    for _ in range(CapturedStep.WARM_UP - 1):
        captured.replay()
    assert weights.tolist() == [2.0, 2.0] and sums.read() == {"loss": 1.0}
    assert places[:2] == [CPU, CPU]
    with pytest.raises(CaptureError, match=r"as a CUDA graph: operation not permitted when stream is capturing\. Use"):
        captured.replay()


def test_a_setting_changed_between_calls_is_seen_by_the_next_update(transitions: Transitions) -> None:
    kwargs = {"dataset": transitions, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 0, "execution": "eager"}
    one, other = (to_float64(OfflineDCE("MlpPolicy", beta=1.0, **kwargs)) for _ in range(2))
    for model in (one, other):
        model.train(2, 8)
    other.beta = 3.0
    for model in (one, other):
        model.train(1, 8)
    assert (one.read_metrics()["beta"], other.read_metrics()["beta"]) == (1.0, pytest.approx(5 / 3))
    assert largest_difference(all_tensors(one), all_tensors(other)) > 0


# -- precision ---------------------------------------------------------------------------------------------------------


def test_unknown_precision_is_refused(transitions: Transitions) -> None:
    with pytest.raises(ConfigError, match="precision"):
        OfflineDCE("MlpPolicy", dataset=transitions, precision="float16")


def test_precision_a_device_does_not_have_is_left_out_with_one_warning(transitions: Transitions) -> None:
    _warn_once.cache_clear()
    kwargs = {"dataset": transitions, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    plain = OfflineDCE("MlpPolicy", **kwargs).learn(3)
    with pytest.warns(SB3DCEWarning, match="tf32.*needs a CUDA device") as caught:
        rounded = OfflineDCE("MlpPolicy", precision="tf32", **kwargs).learn(3)
    assert len([w for w in caught if "tf32" in str(w.message)]) == 1
    assert largest_difference(all_tensors(plain), all_tensors(rounded)) == 0.0


@pytest.mark.parametrize("rounds_itself", [True, False])
def test_precision_is_put_back_even_after_an_error(rounds_itself: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.precision.missing_for", lambda precision, device: None)
    monkeypatch.setattr("sb3_dce.precision._rounds_itself", lambda: rounds_itself)
    before = th.backends.mkldnn.matmul.fp32_precision
    with pytest.raises(RuntimeError, match="stop"), matmul_precision("bf16-matmul", CPU):
        assert (th.backends.mkldnn.matmul.fp32_precision == "bf16") == rounds_itself
        assert (_wide_product_error() > 1e-4) or rounds_itself
        raise RuntimeError("stop")
    assert th.backends.mkldnn.matmul.fp32_precision == before
    with matmul_precision("float32", CPU):
        assert th.backends.mkldnn.matmul.fp32_precision == before
    assert _wide_product_error() < 1e-5


def test_training_computes_denormal_numbers_as_zero_and_leaves_the_thread_as_it_was() -> None:
    half = th.tensor(1e-38) / 2  # denormal itself
    seen: list[float] = []

    class Probe(OfflineDCE):
        def read_state(self, state: Any) -> None:
            seen.append(float(half * 1.5))

        def reads_state_after(self, n_updates: int) -> bool:
            return True

    model = Probe("MlpPolicy", dataset="halfcheetah-tiny-sb3", seed=0, policy_kwargs={"net_arch": [8]}, batch_size=16)
    assert float(half * 1.5) > 0
    model.learn(2)
    assert seen == [0.0, 0.0] and float(half * 1.5) > 0
    with pytest.raises(RuntimeError, match="stop"), denormals_as_zero(), denormals_as_zero():
        raise RuntimeError("stop")
    assert float(half * 1.5) > 0


def test_tf32_is_left_out_by_a_pytorch_without_its_switch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.backends.cuda, "matmul", object())
    assert missing_for("tf32", CUDA) == "PyTorch 2.9 or later"


def _wide_product_error(width: int = 64) -> float:
    """Largest error of a layer against float64; the products are of order 1."""
    generator = th.Generator().manual_seed(0)
    inputs, weight = (th.randn(64, width, generator=generator) / width**0.25 for _ in range(2))
    return float((F.linear(inputs, weight).double() - inputs.double() @ weight.double().T).abs().max())


def test_rounded_layers_multiply_bf16_factors_and_add_the_bias_in_float32() -> None:
    generator = th.Generator().manual_seed(0)
    inputs, weight = (th.randn(40, 64, generator=generator) for _ in range(2))
    bias = th.full((40,), 1000.001)
    with RoundedLinear():
        outputs = F.linear(inputs, weight, bias)
    exact = inputs.bfloat16().double() @ weight.bfloat16().double().T
    assert outputs.dtype == th.float32
    # the product is rounded to 8 bits, the sum with the large bias is not
    assert float(((outputs.double() - bias.double()) - exact).abs().max()) <= float(exact.abs().max()) * 2**-8 + 1e-4


def test_narrow_and_float64_layers_are_not_rounded() -> None:
    generator = th.Generator().manual_seed(0)
    narrow = [th.randn(8, 17, generator=generator), th.randn(256, 17, generator=generator)]
    wide = [th.randn(8, 64, generator=generator).double(), th.randn(64, 64, generator=generator).double()]
    for layer in (narrow, wide):
        with RoundedLinear():
            rounded = F.linear(*layer)
        assert th.equal(rounded, F.linear(*layer))


@needs_compiler
@pytest.mark.slow
def test_rounding_holds_in_compiled_updates(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.precision.missing_for", lambda precision, device: None)
    monkeypatch.setattr("sb3_dce.precision._rounds_itself", lambda: False)
    kwargs = {"dataset": transitions, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}, "seed": 0}
    settings = {"plain": ("eager", "float32"), "eager": ("eager", "bf16-matmul"), "compiled": ("compile", "bf16-matmul")}
    params = {}
    for name, (execution, precision) in settings.items():
        model = OfflineDCE("MlpPolicy", execution=execution, precision=precision, **kwargs)
        model.train(5, 64)
        params[name] = all_tensors(model)
    apart = largest_difference(params["plain"], params["eager"])
    assert apart > 1e-5
    assert largest_difference(params["compiled"], params["eager"]) < apart / 3


@needs_compiler
@pytest.mark.slow
def test_a_compiled_update_follows_the_precision(transitions: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_dce.precision.missing_for", lambda precision, device: None)
    monkeypatch.setattr("sb3_dce.precision._rounds_itself", lambda: False)
    kwargs = {"dataset": transitions, "policy_kwargs": {"net_arch": [32, 32]}, "seed": 0, "device": "cpu"}
    models = {name: OfflineBC("MlpPolicy", execution=name, **kwargs) for name in ("eager", "compile")}
    plain = OfflineBC("MlpPolicy", execution="eager", **kwargs)
    for precision, apart in (("float32", False), ("bf16-matmul", True), ("float32", True)):
        for model in models.values():
            model.precision = precision
            model.train(3, 64)
        plain.train(3, 64)
        eager, compiled = map(all_tensors, models.values())
        rounded = largest_difference(all_tensors(plain), eager)
        assert (rounded > 1e-5) == apart
        assert largest_difference(eager, compiled) < (rounded / 3 if apart else 1e-6)


@needs_compiler
def test_a_compiled_update_follows_the_batch_size(transitions: Transitions) -> None:
    models = []
    for execution in ("eager", "compile"):
        kwargs = {"dataset": transitions, "policy_kwargs": {"net_arch": [16, 16]}, "seed": 0, "execution": execution}
        model = OfflineDCE("MlpPolicy", **kwargs)
        to_float64(model)
        for batch_size in (8, 8, 12, 12, 8):
            model.train(2, batch_size)
        models.append(all_tensors(model))
    assert largest_difference(*models) < 1e-10


@needs_compiler
def test_many_models_of_one_process_are_all_compiled(transitions: Transitions) -> None:
    kwargs = {"dataset": transitions, "execution": "compile", "seed": 0, "device": "cpu"}
    th.compiler.reset()  # what earlier tests have compiled
    with th._dynamo.config.patch(recompile_limit=1):
        for width in (8, 9):
            model = OfflineBC("MlpPolicy", policy_kwargs={"net_arch": [width]}, **kwargs)
            model.train(1, 8)
            assert model._engine.execution == "compile"
        model.train(1, 12)  # another number of rows is another form
    assert model._engine.execution == "compile"


@needs_compiler
@pytest.mark.slow
def test_updates_of_a_very_long_run_are_called_from_compiled_code_and_equal_eager_ones(transitions: Transitions) -> None:
    models = []
    for execution, planned in (("eager", 0), ("compile", UPDATES_WORTH_A_COMPILED_CALLER)):
        kwargs = {"dataset": transitions, "policy_kwargs": {"net_arch": [16, 16]}, "seed": 0, "execution": execution}
        model = to_float64(OfflineDCE("MlpPolicy", **kwargs))
        model._total_timesteps = planned
        model.train(50, 16)
        models.append(model)
    engine = models[1]._engine
    assert engine.execution == "compile" and engine._compiler_options == {"cpp_wrapper": True}
    assert largest_difference(*map(all_tensors, models)) < 1e-10


@pytest.mark.skipif(missing_for("bf16-matmul", CPU) is not None, reason="needs a processor with bf16 products")
def test_bf16_products_change_the_numbers_a_little(transitions: Transitions) -> None:
    kwargs = {"dataset": transitions, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}, "seed": 0}
    plain, rounded = (OfflineDCE("MlpPolicy", precision=p, **kwargs).learn(5) for p in ("float32", "bf16-matmul"))
    # far above the differences that another order of float32 sums makes, about 1e-6
    assert 1e-5 < largest_difference(all_tensors(plain), all_tensors(rounded)) < 0.05
