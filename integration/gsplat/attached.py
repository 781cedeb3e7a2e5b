"""`attach` for gsplat-style loops: a dict of parameters, a dict of optimizers, and `rasterization`."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Final
from weakref import WeakSet

import torch
from torch import Tensor

from clear_strategies.core.gradients import PARAMETERS
from clear_strategies.core.view import View
from clear_strategies.errors import HostError
from clear_strategies.merging.conductor import Conductor
from clear_strategies.signatures import signature_of
from integration.announcement import Once
from integration.attachment import Attachment
from integration.autograd_shot import HostOutput, Target
from integration.densification import require_end, warn_if_score_is_unused
from integration.detail import sh0_offset
from integration.gsplat import calls
from integration.gsplat.calls import Call, Rasterization
from integration.gsplat.optimizers import optimizers_of, step_detail
from integration.gsplat.rows import ROWS, RowNumbers
from integration.host import Host
from integration.hr_drawing import Drawable, RenderAt
from integration.replacing import replaced_attribute, replaced_everywhere
from integration.structure import rows_drawn
from rasterizers.ahead import drawing_ahead
from rasterizers.as_gsplat import rasterizer_of
from rasterizers.interface import BackendUnavailable, Camera, Rasterizer
from rasterizers.modes import uncompiled
from rasterizers.sending import color_on
from rasterizers.torch_internals import is_transformed

_log = logging.getLogger(__name__)

_ATTACHED: Final = "clear_attached"  # attribute of a wrapped function: its Attached


class Attached:
    """The strategies of a conductor in a gsplat-style loop; `attach` makes one.

    Args:
        params: gsplat's dict of parameters (leaf tensors).
        optimizers: gsplat's dict with an optimizer for each parameter, or a single optimizer. The dict may hold others, too, and
            the loop may replace its optimizers.
        views: all training views. A rendering belongs to the view named by `rendering`, or else to the view with its pose.
        strategy: gsplat's densification strategy, whose threshold scales P2G's score; None: a loop without one.
        state: the dict that records changes of structure, instead of `params`: the state of gsplat 1.4's strategy, or `signal`
            of the scene that gsplat 1.6's strategy gets.
        detail: add the detail feature f_det as `params["detail"]`, with an Adam of its own. gsplat's strategies clone,
            split and prune it like any other parameter.
        names: gsplat's parameter name -> the host's, where they differ (nerfstudio: sh0 is features_dc).
        loss_scale, accumulation: see `integration.host.Host`.
        masks: [h, w] by the name of a view, by which the host multiplies the LR image after rendering.
        own_background: True if the loop adds a background to its renderings itself; otherwise strategies may choose the
            `backgrounds` of calls that pass none.
        iterations: length of the loop, for a warning if HR would take part only after its end.
        hr_by: what draws HR and extra views. "host": the wrapped function. A name of `rasterizers.load`: that rasterizer of this
            package. "auto": on CUDA "warp", whose work is replayed, if the wrapped function is gsplat's or ours and "warp"
            supports the call; otherwise "host". Their images differ by at most 3e-3.

    Attributes:
        views: the argument.

    Raises:
        ValueError: there is no view, a parameter is missing, or `params["detail"]` has another number of rows.
        HostError: a network makes the colours; `params` are no dict, hold a tensor that is no leaf, or are attached already.
        SettingError: densification outlasts the anchor; `optimizers` are something else, or a single one that has a learning rate
            scheduler already.
    """

    def __init__(
        self,
        params: MutableMapping[str, Any] | torch.nn.ParameterDict,
        optimizers: MutableMapping[str, Any] | torch.optim.Optimizer,
        views: Sequence[View],
        conductor: Conductor,
        *,
        strategy: Any = None,
        state: dict[str, Any] | None = None,
        detail: bool = True,
        names: Mapping[str, str] | None = None,
        seed: int = 0,
        loss_scale: Callable[[], float] | None = None,
        accumulation: int = 1,
        masks: Mapping[str, Tensor] | None = None,
        own_background: bool = False,
        iterations: int | None = None,
        hr_by: str = "auto",
    ) -> None:
        if not views:
            raise ValueError(
                "at least one view is needed; integration.views.view(...) makes one from an image and a camera."
            )
        self._names = {name: name for name in PARAMETERS} | dict(names or {})
        self._params = params
        if torch.is_inference_mode_enabled():
            raise HostError("tensors that attach makes in torch.inference_mode() cannot be trained. Call it outside.")
        if not isinstance(params, MutableMapping | torch.nn.ParameterDict):
            raise HostError(
                f"params must be a dict or a torch.nn.ParameterDict, to which f_det is added, got {type(params).__name__}. Pass "
                "the dict of which your loop renders."
            )
        require_bands(params)
        if missing := [name for name in self._names.values() if name not in params]:
            raise ValueError(f"params must hold {', '.join(self._names.values())}; {missing[0]} is missing.")
        if any(other._params is params and not other.attachment.removed for other in _MADE):
            raise HostError(
                "these params are attached already; first remove() the attachment that did it, which attach returned. In a "
                "notebook, run also the cells that make the params and their optimizers."
            )
        means = params[self._names["means"]]
        if detail and "detail" not in params:
            params["detail"] = torch.nn.Parameter(means.new_zeros(len(means), 3))
        if "detail" in params and (found := params["detail"].shape) != (len(means), 3):
            raise ValueError(
                f"params['detail'] must have 3 numbers for each of the {len(means):,} Gaussians, got {[*found]}. "
                "If other Gaussians were loaded, delete it there and among the optimizers: attach makes new ones."
            )
        self._added = [*[ROWS] * (state is None), *["detail"] * detail]
        self._optimizers = optimizers
        self._rows = RowNumbers(
            params if state is None else state, lambda: params[self._names["means"]], as_parameter=state is None
        )
        self.views = tuple(views)
        self._poses = calls.Poses(views)
        self._named: tuple[View | None] | None = None  # see `rendering`; None: a view is found by its pose
        self._has_drawn_bands = False  # after a call with spherical harmonics, one without them draws no colours
        self._trains_detail = detail
        self._hr_by, self._log_once = hr_by, Once(_log.info)
        stop, threshold = (getattr(strategy, name, None) for name in ("refine_stop_iter", "grow_grad2d"))
        require_end(conductor, stop, "refine_stop_iter", first=0)
        warn_if_score_is_unused(conductor, strategy, threshold)
        host = Host(
            self.params, self._rows.poll, restart_parents=self._rows.restart, remedy=self._rows.remedy, threshold=threshold,
            loss_scale=loss_scale, accumulation=accumulation, masks=masks or {}, own_background=own_background,
            iterations=iterations,
        )  # fmt: skip
        self.attachment: Attachment = Attachment(conductor, host, views, seed=seed)
        self.attachment.undo.callback(self._rows.remove)
        self.attachment.undo.callback(self._added.clear)
        self._follow_optimizers()
        _MADE.add(self)

    def params(self) -> dict[str, Tensor]:
        """The current leaves, by gsplat's names.

        Raises:
            HostError: the loop has taken out what `attach` added.
        """
        if lost := [name for name in self._added if name not in self._params]:
            raise HostError(
                f"params have lost {' and '.join(lost)}, which attach added. A loop that fills them anew must keep every entry; "
                "where it has loaded other Gaussians, remove() and attach again."
            )
        names = self._names | ({"detail": "detail"} if "detail" in self._params else {})
        return {name: self._params[host_name] for name, host_name in names.items()}

    def wrap(self, rasterization: Rasterization) -> Rasterization:
        """Wrap `rasterization`: it renders training views at both scales, and adds f_det to renderings without gradients."""
        if (attached := getattr(rasterization, _ATTACHED, None)) is not None and not attached.attachment.removed:
            raise HostError(
                "this rasterization is wrapped already; remove() the attachment that wrapped it first, or "
                "wrap rasterization.__wrapped__."
            )
        signature = signature_of(rasterization)
        var_keyword = [name for name, p in signature.parameters.items() if p.kind is p.VAR_KEYWORD]
        if missing := {"means", "opacities", "colors", "viewmats", "Ks", "width", "height"} - {*signature.parameters}:
            raise HostError(
                f"{rasterization} is not gsplat's rasterization: it has no parameter {', '.join(sorted(missing))}. Wrap the "
                "function that takes them by name."
            )

        is_ours = "rgb_offset" in signature.parameters
        preset = rasterization.keywords if isinstance(rasterization, functools.partial) else {}

        @functools.wraps(rasterization)
        @uncompiled
        def wrapped(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
            call = {**preset, **signature.bind(*args, **kwargs).arguments}
            for name in var_keyword:
                call |= call.pop(name, {})
            if self.attachment.removed or is_transformed() or not self._draws_colors(call):
                return rasterization(**call)
            read, view = functools.cache(functools.partial(calls.cameras_read, call)), None
            if torch.is_grad_enabled():
                view = self._poses.find(read()["viewmats"]) if self._named is None else self._named[0]
            if view is None:  # evaluation, a viewer, a camera without a photo
                return rasterization(**self._with_detail(call, is_ours=is_ours, trained=False))
            calls.require_photo(call, view, len(self._params[self._names["means"]]))
            call = calls.of_one_camera(call)
            if self._named is None:
                calls.require_own_intrinsics(read()["Ks"], view)
            calls.require_pinhole(call, self.attachment.conductor.showing)
            self._follow_optimizers()
            if is_ours and not call["viewmats"].requires_grad:
                call |= read()  # which it would read from a device itself, and so wait for HR
            render_at = self._renderer(rasterization, call, read, is_ours=is_ours)
            with self._together(rasterization, call) if is_ours else nullcontext():
                return self.attachment.render_view(view, render_at)  # type: ignore[no-any-return]

        setattr(wrapped, _ATTACHED, self)
        return wrapped

    @contextmanager
    def rendering(self, view: View | None) -> Iterator[None]:
        """A context in which renderings with gradients belong to this view, whatever their pose (pose optimization, pose noise).
        None: they belong to no training view, e.g. a second pass for normals, and f_det is not added.
        """
        with replaced_attribute(self, "_named", (view,)):
            yield

    def replace_everywhere(self, rasterization: Rasterization) -> Rasterization:
        """Replace the function by its wrapped version in every loaded module, under any name; `remove` undoes it."""
        wrapped = self.wrap(rasterization)
        self.attachment.undo.enter_context(replaced_everywhere(rasterization, wrapped))
        return wrapped

    @torch.no_grad()
    def fold_detail(self) -> None:
        """Add f_det to sh0 and set it to 0, for exports and viewers without a detail feature."""
        if "detail" in self._params:
            sh0, detail = self._params[self._names["sh0"]], self._params["detail"]
            sh0 += sh0_offset(detail, sh0)
            detail.zero_()

    def remove(self) -> None:
        """Restore the loop; f_det stays a parameter, see `fold_detail`."""
        self.attachment.remove()

    def _follow_optimizers(self) -> None:
        """Hook the optimizers that the host has now."""
        params = self.params()
        found = optimizers_of(self._optimizers, params, self._names.values())
        if self._trains_detail:
            found = step_detail(self._optimizers, found, self._params["detail"], self.attachment.conductor.detail)
        self.attachment.hook(found)

    def _together(self, rasterization: Rasterization, call: Call) -> AbstractContextManager[None]:
        """A context in which HR and LR share work, if this package's function draws both."""
        if self._own_rasterizer(rasterization, call) is not None:
            return nullcontext()
        pose, K = (call[name].detach().reshape(n, n) for name, n in (("viewmats", 4), ("Ks", 3)))
        return drawing_ahead(pose, K, call["width"], call["height"])

    def _draws_colors(self, call: Call) -> bool:
        """Return True if a call draws the colours of the scene, and not only depth, normals or other features."""
        as_bands = call.get("sh_degree") is not None
        self._has_drawn_bands |= as_bands
        if "RGB" not in call.get("render_mode", "RGB") or call["colors"].shape[-1] != 3:
            return False
        return as_bands or not (self._has_drawn_bands or self._named == (None,))

    def _renderer(
        self, rasterization: Rasterization, arguments: Call, cameras: Callable[[], Mapping[str, Tensor]], *, is_ours: bool
    ) -> RenderAt:  # fmt: skip
        """What draws a call of the function at each scale, and from other cameras.

        Args:
            cameras: returns those of the call, see `calls.cameras_read`.
        """

        @functools.cache  # the product is the same tensor at both scales, and none is kept for longer
        def gated(gate: Tensor) -> Tensor:
            opacities: Tensor = arguments["opacities"]
            return opacities * gate.to(opacities)

        def render_at(target: Target, gate: Tensor | None, view: View) -> HostOutput | Drawable:
            call, params = {**arguments, **self._background(arguments)}, self.params()
            if gate is not None:
                call["opacities"] = gated(gate)
            own = None if target == "lr" else self._own_rasterizer(rasterization, call)
            if target == "hr":
                if own is None:
                    call = self._with_detail(call, is_ours=is_ours, trained=True)
                else:
                    call |= cameras()
                call = calls.enlarged(call, view.factor)
                call |= {"packed": False} if is_ours else {}  # nobody reads its `info`
            else:
                params.pop("detail", None)
            camera = target if isinstance(target, Camera) else None
            if own is not None:
                return calls.drawable(own, call, params, camera)
            if camera is not None:
                call = calls.seen_by(call, camera)
            call, aliases = (call, None) if is_ours else calls.aliased(call)
            return calls.host_output(rasterization, call, params, gate, aliases if target == "lr" else None)

        return render_at

    def _own_rasterizer(self, rasterization: Rasterization, call: Call) -> Rasterizer | None:
        """The rasterizer of this package that draws HR and extra views; None: the host's function does. Logs the choice once."""
        if self._hr_by == "host" or (self._hr_by == "auto" and call["means"].device.type != "cuda"):
            return None
        if self._hr_by == "auto" and not calls.draws_its_arguments(rasterization):
            self._log_once(
                "HR and extra views are drawn by the host's own function, since it may draw more than its arguments say. If it "
                'only calls gsplat\'s rasterization with them, attach(…, hr_by="warp") draws them faster.'
            )
            return None
        backend = "warp" if self._hr_by == "auto" else self._hr_by
        rasterizer = None
        try:
            rasterizer = rasterizer_of(call, backend)
            by = f"this package's rasterizer {backend}, LR by the host's function."
        except (ValueError, BackendUnavailable) as error:
            if self._hr_by != "auto":
                raise
            by = f"the host's own function: {error}"
        self._log_once(f"HR and extra views are drawn by {by}")
        return rasterizer

    def _background(self, call: Call) -> dict[str, Tensor]:
        """The `backgrounds` that the strategies choose for a call; empty if it names its own."""
        color = self.attachment.background
        if color is None or call.get("backgrounds") is not None:
            return {}
        return {"backgrounds": color_on(color, call["means"].device, call["means"].dtype)}

    def _with_detail(self, arguments: Call, *, is_ours: bool, trained: bool) -> dict[str, Any]:
        """The same call with colours f_base + f_det.

        Args:
            is_ours: see `calls.with_offset`. trained: whether f_det gets a gradient.
        """
        detail = self._params.get("detail")
        if detail is None:
            return dict(arguments)
        if not trained:  # a loop may draw part of the scene, or in another order
            detail, rows = detail.detach(), rows_drawn(arguments["means"].detach(), self.params()["means"].detach())
            if rows is not None:
                detail = detail[rows.clamp_min(0)] * (rows >= 0)[..., None]
        return calls.with_offset(arguments, detail, is_ours=is_ours)


attach = Attached
_MADE: Final = WeakSet[Attached]()  # all that exist, since a loop does not show that it is attached


def require_bands(params: Mapping[str, Any] | torch.nn.ParameterDict) -> None:
    """Raise a HostError where a network makes the colours."""
    if "features" in params and "sh0" not in params:
        raise HostError(
            "the splats hold features in place of sh0 and shN, of gsplat's harmonic textures or of an appearance model. The "
            "strategies merge gradients of spherical harmonics: train with simple_trainer.py in place of simple_trainer_nht.py, "
            "without app_opt."
        )
