"use strict";
// The two viewers of report.html: images of test views (slide, flip, side by side), and maps over training views. Both
// draw on a canvas with one zoom for all images; enlarged pixels stay squares. The address after "#" holds the state of a
// viewer of test views, so that a link restores it.

const data = JSON.parse(document.getElementById("data").textContent);
const magma = data.magma.map((hex) => [0, 2, 4].map((i) => parseInt(hex.slice(i, i + 2), 16)));
const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

// The embedded image, or null until it is decoded; `redraw` is then called.
const decoded = new Map();
function embedded(key, redraw) {
  if (!decoded.has(key)) {
    const image = new Image();
    decoded.set(key, null);
    image.onload = () => { decoded.set(key, image); redraw(); };
    image.src = data.images[key];
  }
  return decoded.get(key);
}

function pixels(image, width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingEnabled = image.width > width;
  context.drawImage(image, 0, 0, width, height);
  return { canvas, context, content: context.getImageData(0, 0, width, height) };
}

// Replace every pixel by the colour of number(pixels, index), which lies in [0, 1].
function coloured({ canvas, context, content }, number) {
  for (let i = 0; i < content.data.length; i += 4) {
    const rgb = magma[Math.round(255 * clamp(number(content.data, i), 0, 1))];
    [content.data[i], content.data[i + 1], content.data[i + 2]] = rgb;
  }
  context.putImageData(content, 0, 0);
  return canvas;
}

const cache = new Map();
function cached(name, compute) {
  if (!cache.has(name)) cache.set(name, compute());
  return cache.get(name);
}

// Mean over RGB of |image - truth|; the colours end at errorMax.
function errorMap(image, truth, view, name) {
  return cached(name, () => {
    const t = pixels(truth, view.width, view.height).content.data;
    const error = (a, i) =>
      (Math.abs(a[i] - t[i]) + Math.abs(a[i + 1] - t[i + 1]) + Math.abs(a[i + 2] - t[i + 2])) / 765;
    return coloured(pixels(image, view.width, view.height), (a, i) => error(a, i) / data.errorMax);
  });
}

function element(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value);
  }
  node.append(...children);
  return node;
}

function dropdown(label, options, onChoice) {
  const select = element("select", { onchange: () => onChoice(select.selectedIndex) });
  options.forEach((option) => select.append(element("option", {}, option)));
  return { node: element("label", {}, label, select), show: (i) => { select.selectedIndex = i; } };
}

function segments(label, options, onChoice) {
  const buttons = options.map((option, i) => element("button", { type: "button", onclick: () => onChoice(i) }, option));
  const node = element("span", { class: "segments", role: "group", "aria-label": label }, ...buttons);
  return { node, show: (i) => buttons.forEach((b, k) => b.setAttribute("aria-pressed", String(k === i))) };
}

function colourScale() {
  const stops = [0, 64, 128, 192, 255].map((i) => `#${data.magma[i]}`).join(",");
  const high = element("span");
  const node = element("span", { class: "scale" }, "0", element("i", { style: `background:linear-gradient(90deg,${stops})` }), high);
  return { node, show: (visible, text) => { node.hidden = !visible; high.textContent = text; } };
}

// A canvas with zoom (wheel, + and -) and pan (drag, Shift + arrows). `paint` draws it; `onDrag` and `onKey` return whether
// they used the event.
class Stage {
  constructor(name, paint, onDrag, onKey) {
    this.zoom = 1;
    this.centre = [0.5, 0.5];
    this.paint = paint;
    this.canvas = element("canvas", { tabindex: "0", role: "img", "aria-label": name });
    this.canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomBy(Math.exp(-event.deltaY / 300));
    }, { passive: false });
    this.canvas.addEventListener("pointerdown", (down) => {
      this.canvas.setPointerCapture(down.pointerId);
      let last = [down.offsetX, down.offsetY];
      const used = onDrag(down.offsetX / this.canvas.clientWidth, true);
      const move = (event) => {
        if (used) onDrag(event.offsetX / this.canvas.clientWidth, false);
        else this.pan(last[0] - event.offsetX, last[1] - event.offsetY);
        last = [event.offsetX, event.offsetY];
      };
      this.canvas.onpointermove = move;
      this.canvas.onpointerup = this.canvas.onpointercancel = () => { this.canvas.onpointermove = null; };
    });
    this.canvas.addEventListener("keydown", (event) => {
      const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (arrow && event.shiftKey) this.pan(arrow[0] * 40, arrow[1] * 40);
      else if (event.key === "+" || event.key === "=") this.zoomBy(2);
      else if (event.key === "-") this.zoomBy(0.5);
      else if (event.key === "0") this.fit();
      else if (!onKey(event, arrow)) return;
      event.preventDefault();
    });
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  zoomBy(factor) { this.zoom = clamp(this.zoom * factor, 1, 64); this.draw(); }
  fit() { this.zoom = 1; this.centre = [0.5, 0.5]; this.draw(); }
  pan(x, y) {
    this.centre[0] += x / (this.scale * this.size.width);
    this.centre[1] += y / (this.scale * this.size.height);
    this.draw();
  }

  // Show `panels` images of one size beside each other.
  show(size, panels) { this.size = size; this.panels = panels; this.draw(); }

  draw() {
    if (!this.size || !this.canvas.clientWidth) return;
    const ratio = window.devicePixelRatio || 1, width = this.canvas.clientWidth / this.panels;
    const height = Math.min(width * this.size.height / this.size.width, window.innerHeight * 0.8);
    this.canvas.style.height = `${height}px`;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.scale = Math.min(width / this.size.width, height / this.size.height) * this.zoom;  // CSS px per image pixel
    for (const [k, extent] of [[0, width / this.size.width], [1, height / this.size.height]]) {
      const half = Math.min(0.5, extent / this.scale / 2);
      this.centre[k] = clamp(this.centre[k], half, 1 - half);
    }
    this.context = this.canvas.getContext("2d");
    this.context.scale(ratio, ratio);
    this.panel = { width, height };
    this.paint(this);
  }

  // Draw an image into panel `k`, clipped to the shares `from` to `to` of the panel's width.
  put(image, k = 0, from = 0, to = 1, alpha = 1) {
    if (!image) return;
    const c = this.context, { width, height } = this.panel, left = k * width;
    const w = this.size.width * this.scale, h = this.size.height * this.scale;
    c.save();
    c.beginPath();
    c.rect(left + from * width, 0, (to - from) * width, height);
    c.clip();
    c.globalAlpha = alpha;
    c.imageSmoothingEnabled = w < image.width;
    c.drawImage(image, left + width / 2 - this.centre[0] * w, height / 2 - this.centre[1] * h, w, h);
    c.restore();
  }

  divider(share) {
    const c = this.context, x = share * this.panel.width;
    c.fillStyle = "rgba(0,0,0,.45)";
    c.fillRect(x - 1.5, 0, 3, this.panel.height);
    c.fillStyle = "#fff";
    c.fillRect(x - 0.5, 0, 1, this.panel.height);
    c.beginPath();
    c.arc(x, this.panel.height / 2, 9, 0, 7);
    c.fill();
  }
}

const MODES = ["slide", "flip", "side by side"];

function viewer(holder, number) {
  const scene = data.scenes[number], layers = () => scene.views[state.view].layers;
  const last = scene.views[0].layers.length - 1;
  const truth = scene.views[0].layers.findIndex((layer) => layer.kind === "truth");
  const state = { view: 0, left: truth > 0 ? truth : 0, right: last, mode: 0, split: 0.5, flipped: 0, error: 0 };
  const stage = new Stage(`test views of ${scene.name}`, paint, drag, key);

  const names = layers().map((layer) => layer.label);
  const controls = {
    view: segments("view", scene.views.map((view) => view.name), (i) => set({ view: i })),
    left: dropdown("left", names, (i) => set({ left: i })),
    right: dropdown("right", names, (i) => set({ right: i })),
    mode: segments("mode", MODES, (i) => set({ mode: i })),
  };
  const error = element("input", { type: "checkbox", onchange: () => set({ error: Number(error.checked) }) });
  const scale = colourScale();
  const captions = element("div", { class: "captions", "aria-live": "polite" });
  const zoom = segments("zoom", ["−", "fit", "+"], (i) => (i === 1 ? stage.fit() : stage.zoomBy(i ? 2 : 0.5)));
  holder.append(
    element("div", { class: "controls" }, controls.view.node, controls.left.node, controls.right.node, controls.mode.node,
      zoom.node, element("label", {}, error, "error map")),
    stage.canvas, captions,
    element("p", { class: "hint" }, "Drag the line; wheel zooms, drag pans. Keys on the image: ",
      ...["←", "→"].map((k) => element("kbd", {}, k)), " line, ", element("kbd", {}, "space"), " flip, ",
      element("kbd", {}, "1"), "–", element("kbd", {}, "9"), " right, ", element("kbd", {}, "Shift"), " + digit left, ",
      element("kbd", {}, "v"), " next view, ", element("kbd", {}, "m"), " mode, ", element("kbd", {}, "e"), " error, ",
      element("kbd", {}, "+"), " ", element("kbd", {}, "−"), " ", element("kbd", {}, "0"), " zoom."),
  );
  if (truth < 0) error.disabled = true;
  restoreState();
  set({});

  function set(change) {
    Object.assign(state, change);
    for (const name of Object.keys(controls)) controls[name].show(state[name]);
    error.checked = Boolean(state.error);
    scale.show(Boolean(state.error), `${data.errorMax} mean |difference| over RGB`);
    const [left, right] = [state.left, state.right].map((i) => layers()[i]);
    const caption = (layer) => [element("b", {}, layer.label), layer.note ? ` ${layer.note}` : ""];
    const both = [element("span", {}, ...caption(left)), element("span", {}, ...caption(right))];
    captions.replaceChildren(both[state.mode === 1 ? state.flipped : 0], scale.node, state.mode === 1 ? "" : both[1]);
    stage.show(scene.views[state.view], state.mode === 2 ? 2 : 1);
  }

  function layerImage(i) {
    const view = scene.views[state.view], layer = layers()[i];
    const image = embedded(layer.image, () => stage.draw());
    if (!state.error || layer.kind === "truth") return image;
    const target = embedded(layers()[truth].image, () => stage.draw());
    return image && target && errorMap(image, target, view, `error ${layer.image} ${layers()[truth].image}`);
  }

  function paint() {
    if (state.mode === 2) {
      stage.put(layerImage(state.left), 0);
      stage.put(layerImage(state.right), 1);
    } else if (state.mode === 1) {
      stage.put(layerImage(state.flipped ? state.right : state.left));
    } else {
      stage.put(layerImage(state.left), 0, 0, state.split);
      stage.put(layerImage(state.right), 0, state.split, 1);
      stage.divider(state.split);
    }
    saveState();
  }

  function drag(share, starts) {
    const near = Math.abs(share - state.split) * stage.panel.width < 24;
    if (state.mode !== 0 || (starts && stage.zoom > 1 && !near)) return false;
    set({ split: clamp(share, 0, 1) });
    return true;
  }

  function key(event, arrow) {
    const digit = /^Digit([1-9])$/.exec(event.code);
    if (arrow && arrow[0] && state.mode === 0) set({ split: clamp(state.split + 0.02 * arrow[0], 0, 1) });
    else if (event.key === " ") set(state.mode === 1 ? { flipped: 1 - state.flipped } : { left: state.right, right: state.left });
    else if (digit && Number(digit[1]) <= last + 1) set({ [event.shiftKey ? "left" : "right"]: Number(digit[1]) - 1 });
    else if (event.key === "v") set({ view: (state.view + 1) % scene.views.length });
    else if (event.key === "m") set({ mode: (state.mode + 1) % MODES.length });
    else if (event.key === "e" && truth >= 0) set({ error: 1 - state.error });
    else return false;
    return true;
  }

  function restoreState() {
    const saved = new URLSearchParams(location.hash.slice(1));
    if (Number(saved.get("scene") ?? -1) !== number) return;
    const limits = { view: scene.views.length - 1, left: last, right: last, mode: 2, split: 1, flipped: 1, error: truth < 0 ? 0 : 1 };
    for (const [name, high] of Object.entries(limits)) {
      const value = Number(saved.get(name) ?? NaN);
      if (Number.isFinite(value)) state[name] = name === "split" ? clamp(value, 0, 1) : Math.round(clamp(value, 0, high));
    }
    const [zoom, x, y] = ["zoom", "x", "y"].map((name) => Number(saved.get(name) ?? NaN));
    if (zoom >= 1) [stage.zoom, stage.centre] = [Math.min(zoom, 64), [x || 0.5, y || 0.5]];
  }

  function saveState() {
    if (document.activeElement !== stage.canvas && !holder.contains(document.activeElement)) return;
    const saved = { scene: number, ...state, split: state.split.toFixed(3), zoom: stage.zoom.toFixed(2),
      x: stage.centre[0].toFixed(3), y: stage.centre[1].toFixed(3) };
    history.replaceState(null, "", `#${new URLSearchParams(saved)}`);
  }
}

const MAPS = {
  reliability: "R, reliability: does the prior agree with the LR photo?",
  demand: "A, demand: how much detail does the prior add here?",
  weight: "w = R·A: routes high-frequency gradients",
  corrected: "corrected: share of its HR gradient that a Gaussian lost",
  conflict: "conflict: Gaussians whose LR and HR gradients point apart",
};

function maps(holder, number) {
  const scene = data.scenes[number], state = { view: 0, method: 0, map: 0, under: 0, opacity: 0.7 };
  const kinds = Object.keys(MAPS).filter((kind) => scene.maps.some((view) => view.methods.some((m) => kind in m.maps)));
  const stage = new Stage(`maps of ${scene.name}`, paint, () => false, key);
  const methods = scene.maps[0].methods.map((method) => method.label);
  const controls = {
    view: segments("view", scene.maps.map((view) => view.name), (i) => set({ view: i })),
    map: segments("map", kinds, (i) => set({ map: i })),
    method: dropdown("of", methods, (i) => set({ method: i })),
    under: dropdown("over", scene.maps[0].under.map((u) => u.label), (i) => set({ under: i })),
  };
  const opacity = element("input", { type: "range", min: "0", max: "1", step: "0.05", value: String(state.opacity),
    oninput: () => set({ opacity: Number(opacity.value) }) });
  const scale = colourScale(), caption = element("div", { class: "captions", "aria-live": "polite" });
  holder.append(
    element("div", { class: "controls" }, ...Object.values(controls).map((c) => c.node),
      element("label", {}, "opacity", opacity)),
    stage.canvas, caption,
  );
  state.method = scene.maps[0].methods.findLastIndex((method) => "corrected" in method.maps);
  if (state.method < 0) state.method = methods.length - 1;
  set({});

  function set(change) {
    Object.assign(state, change);
    for (const name of Object.keys(controls)) controls[name].show(state[name]);
    const view = scene.maps[state.view], method = view.methods[state.method], kind = kinds[state.map];
    const mean = method && method.means[kind];
    scale.show(true, String(view.tops[kind]));
    const known = method && kind in method.maps;
    caption.replaceChildren(element("span", {}, element("b", {}, MAPS[kind])), scale.node,
      element("span", {}, known ? (mean == null ? "" : `mean ${mean.toFixed(3)}`) : "this method has no such map of this view"));
    stage.show(view, 1);
  }

  function paint() {
    const view = scene.maps[state.view], kind = kinds[state.map], top = view.tops[kind];
    stage.put(embedded(view.under[state.under].image, () => stage.draw()));
    const key = view.methods[state.method]?.maps[kind];
    const grey = key && embedded(key, () => stage.draw());
    if (!grey) return;
    const overlay = cached(`map ${key} ${top}`, () =>
      coloured(pixels(grey, grey.width, grey.height), (a, i) => a[i] / 255 / top));
    stage.put(overlay, 0, 0, 1, state.opacity);
  }

  function key(event) {
    if (event.key === "v") set({ view: (state.view + 1) % scene.maps.length });
    else if (event.key === "m") set({ map: (state.map + 1) % kinds.length });
    else return false;
    return true;
  }
}

document.querySelectorAll(".viewer").forEach((holder) => viewer(holder, Number(holder.dataset.scene)));
document.querySelectorAll(".maps").forEach((holder) => maps(holder, Number(holder.dataset.scene)));
