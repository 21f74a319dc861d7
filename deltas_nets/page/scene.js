// Points, triangles and cameras in WebGL: drawn when something has changed, and not otherwise.

const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

const VERTEX = `#version 300 es
in vec3 place; in vec3 colour;
uniform mat4 see; uniform vec3 low, span; uniform float size;
out vec3 tint, world;
void main() {
  world = low + span * place;
  gl_Position = see * vec4(world, 1.);
  gl_PointSize = clamp(size / gl_Position.w, 1.5, 32.);
  tint = colour;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 tint, world;
uniform vec3 eye; uniform int form;  // 0 points, 1 triangles, 2 lines
out vec4 colour;
void main() {
  vec2 off = gl_PointCoord - .5;
  if (form == 0 && dot(off, off) > .25) discard;
  vec3 normal = normalize(cross(dFdx(world), dFdy(world)));
  float light = form == 1 ? .55 + .45 * abs(dot(normal, normalize(eye - world))) : 1.;
  colour = vec4(tint * light, 1.);
}`;

// Vectors, and matrices column by column

const add = (a, b, s = 1) => a.map((x, i) => x + s * b[i]);
const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
const cross = ([a, b, c], [d, e, f]) => [b * f - c * e, c * d - a * f, a * e - b * d];
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));
const median = (numbers) => [...numbers].sort((a, b) => a - b)[numbers.length >> 1];

function multiplied(a, b) {
  const product = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) product[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return product;
}

function seenFrom(eye, right, up, back) {
  return [right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
    -dot(right, eye), -dot(up, eye), -dot(back, eye), 1];
}

function perspective(slope, aspect, near, far) {
  return [1 / (slope * aspect), 0, 0, 0, 0, 1 / slope, 0, 0,
    0, 0, (near + far) / (near - far), -1, 0, 0, 2 * near * far / (near - far), 0];
}

// What a camera looks like: a pyramid, with a mark where up is

const FACES = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1], [1, 5], [5, 2]];

function pyramid({ pose, slopes: [left, top, right, bottom] }, size) {
  const corners = [[0, 0, 0], [left, top, 1], [right, top, 1], [right, bottom, 1],
    [left, bottom, 1], [(left + right) / 2, top - (bottom - top) / 4, 1]];
  const world = corners.map((corner) => [0, 4, 8].map(
    (row) => size * dot(corner, pose.slice(row, row + 3)) + pose[row + 3]));
  return FACES.flatMap(([a, b]) => [...world[a], ...world[b]]);
}

function sceneIn(canvas, { up, layers, cameras }, onCamera) {
  const gl = canvas.getContext("webgl2", { antialias: true });
  const nothing = () => {};
  if (!gl) {
    canvas.replaceWith("This browser shows no WebGL, which the scene needs.");
    return { layers: [], select: nothing, toggle: nothing, reset: nothing, asFrame: nothing };
  }

  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  ["place", "colour"].forEach((name, slot) => gl.bindAttribLocation(program, slot, name));
  gl.linkProgram(program);
  gl.useProgram(program);
  const uniform = Object.fromEntries(["see", "low", "span", "size", "eye", "form"]
    .map((name) => [name, gl.getUniformLocation(program, name)]));
  gl.enable(gl.DEPTH_TEST);

  function buffer(target, content) {
    gl.bindBuffer(target, gl.createBuffer());
    gl.bufferData(target, content, gl.STATIC_DRAW);
  }

  const drawn = layers.map((layer, place) => {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    [[layer.xyz, gl.UNSIGNED_SHORT], [layer.rgb, gl.UNSIGNED_BYTE]].forEach(([text, type], slot) => {
      buffer(gl.ARRAY_BUFFER, bytes(text));
      gl.enableVertexAttribArray(slot);
      gl.vertexAttribPointer(slot, 3, type, true, 0, 0);
    });
    if (layer.faces) buffer(gl.ELEMENT_ARRAY_BUFFER, bytes(layer.faces));
    const extent = Math.hypot(...add(layer.box[1], layer.box[0], -1));
    return { ...layer, array, shown: place === 0, spacing: 1.5 * extent / Math.sqrt(layer.count) };
  });

  // How large things are: what is there, and how far cameras are apart

  const centres = cameras.map(({ pose }) => [pose[3], pose[7], pose[11]]);
  const boxes = layers.length ? layers.flatMap(({ box }) => box) : centres;
  const low = [0, 1, 2].map((axis) => Math.min(...boxes.map((point) => point[axis])));
  const high = [0, 1, 2].map((axis) => Math.max(...boxes.map((point) => point[axis])));
  const radius = Math.hypot(...add(high, low, -1)) / 2 || 1;
  const steps = centres.slice(1).map((centre, i) => Math.hypot(...add(centre, centres[i], -1)));
  const size = Math.min(0.08 * radius, Math.max(0.02 * radius, 0.5 * (median(steps) || 0)));
  const lines = gl.createVertexArray();
  gl.bindVertexArray(lines);
  buffer(gl.ARRAY_BUFFER, new Float32Array(cameras.flatMap((camera) => pyramid(camera, size))));
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  let camerasShown = true, selected = 0;

  // Where it is seen from: turned about up by yaw and raised by pitch, around a target

  const ahead = unit(cameras.map(({ pose }) => [pose[2], pose[6], pose[10]])
    .reduce((sum, forward) => add(sum, forward)));
  const flat = add(ahead, up, -dot(ahead, up));
  const north = Math.hypot(...flat) > 0.1 ? unit(flat) : unit(cross(up, [up[1], up[2], -up[0]]));
  const east = cross(north, up);
  const view = {};

  function reset() {
    const target = low.map((x, axis) => (x + high[axis]) / 2);
    const tall = Math.max(1, canvas.clientHeight / canvas.clientWidth);
    Object.assign(view, { yaw: 0.35, pitch: 0.5, distance: 1.6 * radius * tall, target, slope: 0.5 });
    changed();
  }

  function asFrame() {
    const camera = cameras.find(({ frame }) => frame === selected);
    if (!camera) return;
    const { pose, slopes } = camera, forward = [pose[2], pose[6], pose[10]];
    const distance = 0.6 * radius;
    Object.assign(view, {
      yaw: Math.atan2(dot(forward, east), dot(forward, north)),
      pitch: Math.asin(Math.max(-1, Math.min(1, -dot(forward, up)))),
      distance,
      target: add([pose[3], pose[7], pose[11]], forward, distance),
      slope: Math.max(slopes[3], (slopes[2] - slopes[0]) / 2 * canvas.clientHeight / canvas.clientWidth),
    });
    changed();
  }

  function axes() {
    const level = add(north.map((x) => Math.cos(view.yaw) * x), east, Math.sin(view.yaw));
    const back = add(level.map((x) => -Math.cos(view.pitch) * x), up, Math.sin(view.pitch));
    const right = unit(cross(up, back));
    return { right, above: cross(back, right), back, eye: add(view.target, back, view.distance) };
  }

  function matrix() {
    const { right, above, back, eye } = axes();
    const aspect = canvas.width / canvas.height, far = view.distance + 8 * radius;
    const near = Math.min(0.02 * radius, 0.05 * view.distance);
    const see = multiplied(perspective(view.slope, aspect, near, far),
      seenFrom(eye, right, above, back));
    return { see, eye };
  }

  function draw() {
    const sharp = Math.min(devicePixelRatio, 2);
    canvas.width = Math.max(1, Math.round(canvas.clientWidth * sharp));
    canvas.height = Math.max(1, Math.round(canvas.clientHeight * sharp));
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.06, 0.067, 0.082, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { see, eye } = matrix();
    gl.uniformMatrix4fv(uniform.see, false, see);
    gl.uniform3fv(uniform.eye, eye);
    for (const layer of drawn.filter(({ shown }) => shown)) {
      gl.bindVertexArray(layer.array);
      gl.uniform3fv(uniform.low, layer.low);
      gl.uniform3fv(uniform.span, layer.span);
      gl.uniform1i(uniform.form, layer.faces ? 1 : 0);
      gl.uniform1f(uniform.size, layer.spacing * canvas.height / (2 * view.slope));
      if (layer.faces) gl.drawElements(gl.TRIANGLES, 3 * layer.count, gl.UNSIGNED_INT, 0);
      else gl.drawArrays(gl.POINTS, 0, layer.count);
    }
    if (!camerasShown) return;
    gl.bindVertexArray(lines);
    gl.uniform3f(uniform.low, 0, 0, 0);
    gl.uniform3f(uniform.span, 1, 1, 1);
    gl.uniform1i(uniform.form, 2);
    gl.vertexAttrib3f(1, 0.45, 0.62, 0.95);
    gl.drawArrays(gl.LINES, 0, 2 * FACES.length * cameras.length);
    const place = cameras.findIndex(({ frame }) => frame === selected);
    if (place < 0) return;
    gl.disable(gl.DEPTH_TEST);
    gl.vertexAttrib3f(1, 1, 0.75, 0.2);
    gl.drawArrays(gl.LINES, 2 * FACES.length * place, 2 * FACES.length);
    gl.enable(gl.DEPTH_TEST);
  }

  let waiting = false;
  function changed() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  }

  // Hands: pointers, wheel, keys

  function turn(x, y) {
    view.yaw -= x;
    view.pitch = Math.max(-1.55, Math.min(1.55, view.pitch + y));
    changed();
  }
  function move(x, y) {  // of the canvas's height
    const { right, above } = axes(), reach = 2 * view.slope * view.distance;
    view.target = add(add(view.target, right, -x * reach), above, y * reach);
    changed();
  }
  function zoom(factor) {
    view.distance = Math.max(0.02 * radius, Math.min(12 * radius, view.distance * factor));
    changed();
  }

  const fingers = new Map();
  let travelled = 0;
  canvas.onpointerdown = (event) => {
    canvas.setPointerCapture(event.pointerId);
    if (!fingers.size) travelled = 0;
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  };
  canvas.onpointermove = (event) => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.clientX, event.clientY], [x, y] = add(now, before, -1);
    const tall = canvas.clientHeight;
    travelled += Math.hypot(x, y);
    if (fingers.size === 2) {
      const [other] = [...fingers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
      const apart = (point) => Math.hypot(...add(point, other, -1)) || 1;
      zoom(apart(before) / apart(now));
      move(x / tall / 2, y / tall / 2);
    } else if (event.buttons & 6 || event.shiftKey) move(x / tall, y / tall);
    else turn(3 * x / tall, 3 * y / tall);
    fingers.set(event.pointerId, now);
  };
  canvas.onpointerup = canvas.onpointercancel = (event) => {
    fingers.delete(event.pointerId);
    if (event.type === "pointerup" && travelled < 4) pick(event.offsetX, event.offsetY);
  };
  canvas.oncontextmenu = (event) => event.preventDefault();
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(Math.max(-100, Math.min(100, event.deltaY)) / 500));
  }, { passive: false });
  canvas.onkeydown = (event) => {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const others = { "+": () => zoom(0.85), "=": () => zoom(0.85), "-": () => zoom(1 / 0.85),
      0: reset, c: asFrame };
    const arrow = arrows[event.key], other = others[event.key.toLowerCase()];
    if (event.ctrlKey || event.metaKey || !(arrow || other)) return;
    event.preventDefault();
    if (!arrow) other();
    else if (event.shiftKey) move(-0.06 * arrow[0], -0.06 * arrow[1]);
    else turn(0.12 * arrow[0], 0.12 * arrow[1]);
  };

  function pick(x, y) {
    const { see } = matrix();
    const found = cameras.map(({ frame }, i) => {
      const [a, b, , w] = [0, 1, 2, 3].map((row) =>
        dot([...centres[i], 1], [see[row], see[row + 4], see[row + 8], see[row + 12]]));
      const px = (a / w + 1) / 2 * canvas.clientWidth, py = (1 - b / w) / 2 * canvas.clientHeight;
      return { frame, far: w > 0 && frame !== null ? Math.hypot(px - x, py - y) : Infinity };
    });
    const best = found.reduce((a, b) => (b.far < a.far ? b : a));
    if (best.far < 16) onCamera(best.frame);
  }

  new ResizeObserver(changed).observe(canvas);
  reset();
  return {
    layers: [...drawn.map(({ name, shown }) => [name, shown]), ["cameras", true]],
    toggle(name, shown) {
      if (name === "cameras") camerasShown = shown;
      else drawn.find((layer) => layer.name === name).shown = shown;
      changed();
    },
    select(frame) { selected = frame; changed(); },
    reset,
    asFrame,
  };
}
