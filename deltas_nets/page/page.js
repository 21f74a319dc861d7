// The page: pictures of a frame over each other and side by side, and the scene beside them.

const data = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);

function element(kind, text = "", more = {}) {
  return Object.assign(document.createElement(kind), { textContent: text }, more);
}

const source = (frame, kind) =>
  frame.pictures[kind] ? `data:image/jpeg;base64,${frame.pictures[kind]}` : "";
const kinds = Object.keys(data.kinds);
const state = { frame: 0, left: "image", right: "depth" };

document.title = `${data.name}: depth maps`;
at("name").textContent = data.name;
at("verdict").textContent = data.verdict.line;
at("verdict").classList.toggle("doubtful", data.verdict.doubtful);
for (const [name, value, told] of data.facts) {
  const box = element("div", "", { title: told });
  box.append(element("dt", name), element("dd", value));
  at("facts").append(box);
}
at("notes").append(...data.notes.map((note) => element("li", note)));
at("footer").textContent = `deltas ${data.version}. Near is red, far is blue, grey is unknown. `
  + "Values under the pointer are read from colours, to about 2 %.";

at("theme").onclick = () => {
  const root = document.documentElement;
  const dark = root.style.colorScheme
    ? root.style.colorScheme === "dark"
    : matchMedia("(prefers-color-scheme: dark)").matches;
  root.style.colorScheme = dark ? "light" : "dark";
};

// Colours as numbers

const tables = Object.fromEntries(
  Object.entries(data.scales).map(([kind, scale]) => [kind, bytes(scale.colours)]));

function valueOf(kind, rgb) {
  const table = tables[kind], scale = data.scales[kind];
  const far = (r, g, b) => (r - rgb[0]) ** 2 + (g - rgb[1]) ** 2 + (b - rgb[2]) ** 2;
  let best = 0, least = Infinity;
  for (let i = 0; i < 256; i++) {
    const distance = far(table[3 * i], table[3 * i + 1], table[3 * i + 2]);
    if (distance < least) [best, least] = [i, distance];
  }
  if (far(...data.none) < least) return null;
  const share = best / 255;
  return scale.log ? scale.low * (scale.high / scale.low) ** share
    : scale.low + share * (scale.high - scale.low);
}

function legendOf(kind) {
  const scale = data.scales[kind];
  if (!scale) return [];
  const table = tables[kind], stops = [];
  for (let i = 0; i < 256; i += 15) stops.push(`rgb(${table.slice(3 * i, 3 * i + 3)})`);
  const bar = element("div", "", { className: "bar" });
  bar.style.background = `linear-gradient(90deg, ${stops})`;
  const ticks = element("div", "", { className: "ticks" });
  for (const [place, text] of scale.ticks) {
    const tick = element("span", `${text} ${scale.unit}`);
    tick.style.left = `${Math.min(97, Math.max(3, 100 * place))}%`;
    ticks.append(tick);
  }
  return [bar, ticks];
}

const pixels = new Map();  // of the current frame, decoded when they are first asked for

async function pixelsOf(kind) {
  const frame = data.frames[state.frame];
  if (!pixels.has(kind)) {
    const image = new Image();
    image.src = source(frame, kind);
    pixels.set(kind, image.decode().then(() => {
      const canvas = new OffscreenCanvas(image.width, image.height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      context.drawImage(image, 0, 0);
      return context;
    }));
  }
  return pixels.get(kind);
}

async function read(x, y) {
  const said = [], asked = state.frame;
  for (const kind of kinds) {
    if (!data.scales[kind] || !data.frames[state.frame].pictures[kind]) continue;
    const context = await pixelsOf(kind), { width, height } = context.canvas;
    const column = Math.min(width - 1, Math.floor(x * width));
    const row = Math.min(height - 1, Math.floor(y * height));
    const value = valueOf(kind, context.getImageData(column, row, 1, 1).data);
    const unit = data.scales[kind].unit;
    const name = data.kinds[kind].toLowerCase();
    if (value !== null) said.push(`${name} ${value.toPrecision(value < 10 ? 2 : 3)} ${unit}`);
  }
  if (asked === state.frame) at("reading").textContent = said.join(" · ");
}

// One picture over the other

function split(share) {
  const held = Math.min(100, Math.max(0, share));
  at("wipe").style.setProperty("--at", `${held}%`);
  at("split").value = held;
}

at("split").oninput = () => split(+at("split").value);
function across(event) {
  const box = at("wipe").getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}
at("wipe").onpointerdown = (event) => {
  at("wipe").setPointerCapture(event.pointerId);
  split(100 * across(event)[0]);
};
at("wipe").onpointermove = (event) => {
  const [x, y] = across(event);
  if (event.buttons) split(100 * x);
  if (x >= 0 && x < 1 && y >= 0 && y < 1) read(x, y);
};
at("wipe").onpointerleave = () => { at("reading").textContent = ""; };

// A tall picture is narrower, so that all of it fits the screen.
at("under").onload = ({ target }) => {
  at("wipe").style.maxWidth = `${85 * target.naturalWidth / target.naturalHeight}vh`;
};
for (const side of ["left", "right"]) {
  for (const kind of kinds) at(side).append(element("option", data.kinds[kind], { value: kind }));
  at(side).onchange = () => { state[side] = at(side).value; show(); };
}

// Frames

const scene = sceneIn(at("canvas"), data.scene, (frame) => select(frame));
const thumbnails = data.frames.map((frame, place) => {
  const button = element("button", "", { type: "button", title: frame.id });
  const image = new Image();
  Object.assign(image, { loading: "lazy", alt: `Frame ${frame.id}`, src: source(frame, "image") });
  button.append(image);
  button.onclick = () => select(place);
  return button;
});
at("strip").append(...thumbnails);
at("frame").max = data.frames.length - 1;
for (const id of ["previous", "play", "next", "frame"]) at(id).disabled = data.frames.length < 2;

const panels = kinds.map((kind) => {
  const button = element("button", "", { type: "button" });
  button.append(new Image(), element("span", data.kinds[kind]));
  button.onclick = () => { state.right = kind; show(); };
  return button;
});
at("panels").append(...panels);

function select(place) {
  const count = data.frames.length;
  state.frame = ((place % count) + count) % count;
  pixels.clear();
  at("reading").textContent = "";
  show();
}

function show() {
  const frame = data.frames[state.frame];
  for (const [id, side] of [["under", "left"], ["over", "right"]]) {
    at(id).src = source(frame, state[side]) || source(frame, "image");
    at(id).alt = `${data.kinds[state[side]]} of frame ${frame.id}`;
    at(side).value = state[side];
  }
  const scaled = [state.right, state.left].find((kind) => data.scales[kind]);
  at("legend").replaceChildren(...(scaled ? legendOf(scaled) : []));
  kinds.forEach((kind, place) => {
    const [image] = panels[place].children;
    image.src = source(frame, kind);
    image.alt = `${data.kinds[kind]} of frame ${frame.id}`;
    panels[place].hidden = !frame.pictures[kind];
    panels[place].setAttribute("aria-pressed", kind === state.right);
  });
  thumbnails.forEach((button, place) =>
    button.setAttribute("aria-current", place === state.frame));
  const current = thumbnails[state.frame], strip = at("strip");
  strip.scrollLeft = current.offsetLeft - strip.offsetLeft - (strip.clientWidth - current.clientWidth) / 2;
  at("frame").value = state.frame;
  at("id").textContent = frame.id;
  at("about").textContent = [
    `Frame ${state.frame + 1} of ${data.frames.length}`,
    ...Object.entries(frame.facts).map(([name, value]) => `${name} ${value}`),
  ].join(" · ");
  scene.select(state.frame);
}

let playing = null;
function play(on) {
  clearInterval(playing);
  playing = on ? setInterval(() => select(state.frame + 1), 400) : null;
  at("play").textContent = on ? "Pause" : "Play";
  at("play").setAttribute("aria-pressed", on);
}
at("play").onclick = () => play(playing === null);
at("previous").onclick = () => select(state.frame - 1);
at("next").onclick = () => select(state.frame + 1);
at("frame").oninput = () => select(+at("frame").value);
at("from").onclick = () => scene.asFrame();
at("reset").onclick = () => scene.reset();

addEventListener("keydown", (event) => {
  if (event.target.matches("input, select, canvas") || event.ctrlKey || event.metaKey) return;
  const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
  if (step) { event.preventDefault(); select(state.frame + step); }
});

for (const [name, shown] of scene.layers) {
  const label = element("label"), box = element("input", "", { type: "checkbox", checked: shown });
  box.onchange = () => scene.toggle(name, box.checked);
  label.append(box, name);
  at("layers").append(label);
}
select(0);
