"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const find = (id) => document.getElementById(id);
const limit = (value, low, high) => Math.min(Math.max(value, low), high);

// Where a pointer is in an element, in fractions of its width and height.
function inside(event, element) {
  const box = element.getBoundingClientRect();
  return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
}

// Pictures and their values.

const linear = (code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4);
const encoded = (value) => (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055);

function table(picture) {
  const most = 2 ** picture.bits - 1;
  return Float32Array.from({ length: most + 1 }, (_, code) => picture.full * linear(code / most));
}

async function loaded(picture) {
  const image = new Image();
  image.src = picture.source;
  await image.decode();
  return image;
}

function pixels(image, x, y, width, height, toWidth = width, toHeight = height) {
  const canvas = Object.assign(document.createElement("canvas"), { width: toWidth, height: toHeight });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, x, y, width, height, 0, 0, toWidth, toHeight);
  return context.getImageData(0, 0, toWidth, toHeight).data;
}

// The linear values of a picture, NaN where it is transparent. Of 16 bits the lower eight are below the upper ones.
async function read(picture) {
  const image = await loaded(picture);
  const columns = image.naturalWidth;
  const rows = image.naturalHeight / (picture.bits / 8);
  const bytes = pixels(image, 0, 0, columns, image.naturalHeight);
  const values = new Float32Array(rows * columns * picture.channels);
  const value = table(picture);
  const low = picture.bits === 16 ? 4 * rows * columns : 0;
  for (let k = 0; k < rows * columns; k++) {
    for (let c = 0; c < picture.channels; c++) {
      const at = 4 * k + c;
      const code = low ? 256 * bytes[at] + bytes[low + at] : bytes[at];
      values[k * picture.channels + c] = bytes[4 * k + 3] ? value[code] : NaN;
    }
  }
  return { rows, columns, channels: picture.channels, values };
}

// Light fields: for each view its samples, row by row, each of the light of all colours and the weight.

function lightField(recording, light, weight) {
  const { rows, columns } = recording;
  const [v, u, channels] = [recording.v, recording.u, light.channels];
  const planes = channels + 1;
  const size = rows * columns * planes;
  const samples = new Float32Array(v.length * u.length * size);
  const seen = new Uint8Array(v.length * u.length);
  for (let j = 0; j < v.length; j++) {
    for (let i = 0; i < u.length; i++) {
      const index = j * u.length + i;
      for (let t = 0; t < rows; t++) {
        for (let s = 0; s < columns; s++) {
          const from = (j * rows + t) * u.length * columns + i * columns + s;
          const to = index * size + (t * columns + s) * planes;
          const part = weight.values[from];
          for (let c = 0; c < channels; c++) samples[to + c] = light.values[from * channels + c] * part;
          samples[to + channels] = part;
          if (part > 0.05) seen[index] = 1;
        }
      }
    }
  }
  const view = (j, i) => samples.subarray((j * u.length + i) * size, (j * u.length + i + 1) * size);
  return { ...recording, channels, planes, seen, view };
}

// Divide light by weight; NaN where nothing is seen.
function image(field, samples) {
  const { rows, columns, channels, planes } = field;
  const values = new Float32Array(rows * columns * channels);
  for (let k = 0; k < rows * columns; k++) {
    const weight = samples[k * planes + channels];
    for (let c = 0; c < channels; c++) values[k * channels + c] = weight > 1e-6 ? samples[k * planes + c] / weight : NaN;
  }
  return { rows, columns, channels, values };
}

// Add an array (outer, count, stride) read at `shift` further along its middle axis, linearly.
function addShifted(total, values, shift, outer, count, stride) {
  const whole = Math.floor(shift);
  const part = shift - whole;
  for (const [by, factor] of [[whole, 1 - part], [whole + 1, part]]) {
    const length = (count - Math.abs(by)) * stride;
    if (length <= 0 || factor === 0) continue;
    for (let o = 0; o < outer; o++) {
      const from = (o * count + Math.max(by, 0)) * stride;
      const to = (o * count + Math.max(-by, 0)) * stride;
      for (let k = 0; k < length; k++) total[to + k] += factor * values[from + k];
    }
  }
}

// Shift every view against its parallax and add, as lightfield.shift_and_add does.
function refocused(field, disparity) {
  const { rows, columns, planes, u, v } = field;
  const total = new Float32Array(rows * columns * planes);
  for (let i = 0; i < u.length; i++) {
    const column = new Float32Array(total.length);
    for (let j = 0; j < v.length; j++) {
      if (field.seen[j * u.length + i]) addShifted(column, field.view(j, i), v[j] * disparity, 1, rows, columns * planes);
    }
    addShifted(total, column, u[i] * disparity, rows, columns, planes);
  }
  return image(field, total);
}

// The step of the slider at which the views agree best about the surroundings of a bin; null where all agree.
const AROUND = 2;

function agreedStep(field, row, column) {
  const { rows, columns, channels, planes, u, v } = field;
  let best = null;
  let [least, most] = [Infinity, 0];
  field.disparities.forEach((disparity, step) => {
    let [spread, brightness] = [0, 0];
    for (let t = row - AROUND; t <= row + AROUND; t++) {
      for (let s = column - AROUND; s <= column + AROUND; s++) {
        let [count, sum, squares] = [0, 0, 0];
        for (let j = 0; j < v.length; j++) {
          for (let i = 0; i < u.length; i++) {
            const [y, x] = [t + v[j] * disparity, s + u[i] * disparity];
            const [top, left] = [Math.floor(y), Math.floor(x)];
            if (top < 0 || left < 0 || top + 1 >= rows || left + 1 >= columns) continue;
            const samples = field.view(j, i);
            let [light, weight] = [0, 0];
            const [at, below, right] = [top * columns + left, y - top, x - left];
            for (const [k, factor] of [
              [at, (1 - below) * (1 - right)],
              [at + 1, (1 - below) * right],
              [at + columns, below * (1 - right)],
              [at + columns + 1, below * right],
            ]) {
              for (let c = 0; c < channels; c++) light += factor * samples[k * planes + c] / channels;
              weight += factor * samples[k * planes + channels];
            }
            if (weight < 0.5) continue;
            count += 1;
            sum += light / weight;
            squares += (light / weight) ** 2;
          }
        }
        if (count < 2) continue;
        spread += Math.max(0, squares / count - (sum / count) ** 2);
        brightness += (sum / count) ** 2;
      }
    }
    if (brightness === 0) return;
    const ratio = spread / brightness;
    most = Math.max(most, ratio);
    if (ratio < least) [best, least] = [step, ratio];
  });
  return most > 1e-3 ? best : null;
}

// The image of a stack that has most contrast about a bin.
function sharpestPlane(planes, row, column) {
  const contrasts = planes.map(({ rows, columns, channels, values }) => {
    let [count, sum, squares] = [0, 0, 0];
    for (let t = Math.max(0, row - AROUND); t <= Math.min(rows - 1, row + AROUND); t++) {
      for (let s = Math.max(0, column - AROUND); s <= Math.min(columns - 1, column + AROUND); s++) {
        const value = values[(t * columns + s) * channels];
        if (Number.isNaN(value)) continue;
        count += 1;
        sum += value;
        squares += value ** 2;
      }
    }
    return count ? squares / count - (sum / count) ** 2 : 0;
  });
  const most = Math.max(...contrasts);
  return most > 0 ? contrasts.indexOf(most) : null;
}

// Colours: of values by the exposure, of differences from blue to red, of depths by a ramp.

const RAMP = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

function ramp(part) {
  const at = limit(part, 0, 1) * (RAMP.length - 1);
  const low = Math.min(Math.floor(at), RAMP.length - 2);
  return RAMP[low].map((colour, c) => colour + (at - low) * (RAMP[low + 1][c] - colour));
}

function signed(part) {
  const strength = limit(Math.abs(part), 0, 1);
  const rest = 255 * (1 - strength);
  return part > 0 ? [255 - 50 * strength, rest, rest] : [rest, rest, 255 - 50 * strength];
}

function paint(canvas, picture, colours) {
  const { rows, columns, channels, values } = picture;
  Object.assign(canvas, { width: columns, height: rows });
  const context = canvas.getContext("2d");
  const drawn = context.createImageData(columns, rows);
  for (let k = 0; k < rows * columns; k++) {
    if (Number.isNaN(values[k * channels])) continue;
    const colour = colours(values, k * channels, channels);
    for (let c = 0; c < 3; c++) drawn.data[4 * k + c] = colour[c];
    drawn.data[4 * k + 3] = 255;
  }
  context.putImageData(drawn, 0, 0);
}

// As images.to_bytes encodes them.
const shades = Float32Array.from({ length: 4097 }, (_, k) => 255 * encoded(k / 4096));
// The table is too coarse where it is dark.
const shade = (part) =>
  Math.round(part < 0.01 ? 255 * encoded(Math.max(part, 0)) : shades[Math.round(4096 * Math.min(part, 1))]);

const byExposure = (white) => (values, at, channels) =>
  [0, 1, 2].map((c) => shade(values[at + (channels === 3 ? c : 0)] / white));

const byDifference = (bound) => (values, at, channels) => {
  let sum = 0;
  for (let c = 0; c < channels; c++) sum += values[at + c] / channels;
  return signed(sum / bound);
};

const minus = (one, other) => ({ ...one, values: one.values.map((value, k) => value - other.values[k]) });

const distanceText = (distance) => (distance === "inf" ? "infinity" : `${Number(distance.toPrecision(4))} mm`);
const inverse = (distance) => (distance === "inf" ? 0 : 1 / distance);

async function start() {
  const fields = [];
  const raws = [];
  for (const recording of data.recordings) {
    fields.push(lightField(recording, await read(recording.views), await read(recording.weight)));
    const { raw } = recording;
    raws.push(raw && { ...raw, value: table(raw.picture), image: await loaded(raw.picture) });
  }
  const planes = [];
  for (const plane of data.planes) planes.push({ ...plane, ...(await read(plane.picture)) });
  const depth = data.depth && { ...data.depth, ...(await read(data.depth.picture)) };
  const field = fields[0];

  // What is shown. The source is the index of a capture, or "difference".
  const state = { mode: "", source: 0, view: [0, 0], step: 0, plane: 0, stops: 0, bin: null, lens: null };
  const white = () => data.white * 2 ** -state.stops;

  const modes = {
    ...(field && { view: "Viewpoint" }),
    ...(field && !field.fixed && { refocus: "Refocused" }),
    ...(planes.length && { planes: "Stack" }),
    ...(depth && { depth: "Depth" }),
  };

  function choices(name, entries, chosen, act) {
    find(name).hidden = entries.length < 2;
    for (const [value, title] of entries) {
      const input = document.createElement("input");
      Object.assign(input, { type: "radio", name, value, checked: value === chosen });
      const label = document.createElement("label");
      label.append(input, title);
      find(name).append(label);
      input.addEventListener("change", () => act(value));
    }
  }

  const check = (name, value) => {
    const input = document.querySelector(`input[name=${name}][value="${value}"]`);
    if (input) input.checked = true;
  };

  // The picture of the scene.

  const cache = new Map();
  function refocusedBy(index, step) {
    const key = `${index} ${step}`;
    if (!cache.has(key)) {
      if (cache.size > 8) cache.clear();
      cache.set(key, refocused(fields[index], fields[index].disparities[step]));
    }
    return cache.get(key);
  }

  function shown(index) {
    if (state.mode === "depth") return depth;
    if (state.mode === "planes") return planes[state.plane];
    if (state.mode === "refocus") return refocusedBy(index, state.step);
    return image(fields[index], fields[index].view(...state.view));
  }

  const ofSource = () => state.mode === "view" || state.mode === "refocus";
  const compared = () => state.source === "difference" && ofSource();
  const picture = () => (compared() ? minus(shown(1), shown(0)) : shown(state.source === "difference" ? 0 : state.source));

  function drawField() {
    const now = picture();
    const bound = white() / 4;
    const colours = state.mode === "depth"
      ? (values, at) => ramp((values[at] - depth.low) / (depth.high - depth.low || 1))
      : compared() ? byDifference(bound) : byExposure(white());
    paint(find("field"), now, colours);
    state.picture = now;
    find("field-frame").style.maxWidth = `calc(78vh * ${now.columns / now.rows})`;

    const steps = state.mode === "planes" ? planes.length : field ? field.disparities.length : 1;
    const at = state.mode === "planes" ? state.plane : state.step;
    const slider = find("focus");
    Object.assign(slider, { max: steps - 1, value: at });
    const distance = state.mode === "planes" ? planes[at].distance : field && field.distances[at];
    find("focus-text").textContent = distance
      ? distanceText(distance)
      : field && !field.fixed ? `${field.disparities[at].toFixed(3)} lenses/view` : "";
    slider.setAttribute("aria-valuetext", find("focus-text").textContent);
    find("focus-row").hidden = state.mode === "depth" || steps < 2;
    find("exposure").disabled = state.mode === "depth";
    find("exposure-text").textContent = `${state.stops > 0 ? "+" : ""}${state.stops} stops`;

    const title = state.mode === "planes" ? `${modes.planes}, ${planes[at].method}` : modes[state.mode];
    const names = data.recordings.map((one) => one.name);
    const one = fields.length > 1 && ofSource() ? names[state.source] : "";
    const source = compared() ? `${names[1]} - ${names[0]}` : one;
    find("field-tag").textContent = source ? `${title}: ${source}` : title;

    find("scale").hidden = !(state.mode === "depth" || compared());
    const stops = state.mode === "depth" ? [0, 0.25, 0.5, 0.75, 1].map(ramp) : [-1, -0.5, 0, 0.5, 1].map(signed);
    find("ramp").style.background = `linear-gradient(to right, ${stops.map((colour) => `rgb(${colour.join(" ")})`)})`;
    const ends = state.mode === "depth"
      ? [depth.low, depth.high].map((end) => distanceText(end > 0 ? 1 / end : "inf"))
      : [`-${bound.toPrecision(3)}`, `+${bound.toPrecision(3)}`];
    [find("scale-low").textContent, find("scale-high").textContent] = ends;
    drawBin();
  }

  // The bin that was clicked, and what is there.
  function drawBin() {
    const { rows, columns, channels, values } = state.picture;
    find("cross").hidden = !state.bin;
    if (!state.bin) { find("readout").textContent = ""; return; }
    const [row, column] = [limit(state.bin[0], 0, rows - 1), limit(state.bin[1], 0, columns - 1)];
    const canvas = find("field");
    const scale = canvas.clientWidth / columns;
    Object.assign(find("cross").style, { left: `${(column + 0.5) * scale}px`, top: `${(row + 0.5) * scale}px` });
    const at = (row * columns + column) * channels;
    const numbers = [...values.subarray(at, at + channels)];
    const found = numbers.some(Number.isNaN) ? "unknown"
      : state.mode === "depth" ? (numbers[0] > 0 ? distanceText(1 / numbers[0]) : "infinity")
      : numbers.map((value) => value.toPrecision(3)).join(", ");
    const what = state.mode === "depth" ? "depth" : compared() ? "difference" : "radiance";
    find("readout").textContent = `Bin ${column}, ${row} (column, row from 0): ${what} ${found}`;
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      drawField();
      drawPupil();
      drawRaw();
    });
  }

  function setMode(mode) {
    if (!(mode in modes) || mode === state.mode) return;
    // The same distance, as nearly as may be.
    if (mode === "planes" && field && state.mode) {
      state.plane = nearest(planes.map((one) => one.distance), field.distances[state.step]);
    }
    if (mode === "refocus" && state.mode === "planes") state.step = nearest(field.distances, planes[state.plane].distance);
    state.mode = mode;
    check("modes", mode);
  }

  function nearest(distances, wanted) {
    if (!wanted) return state.step < distances.length ? state.step : 0;
    const apart = distances.map((distance) => (distance ? Math.abs(inverse(distance) - inverse(wanted)) : Infinity));
    return apart.indexOf(Math.min(...apart));
  }

  function setStep(step) {
    if (state.mode === "planes") {
      state.plane = limit(step, 0, planes.length - 1);
    } else if (field && !field.fixed) {
      setMode("refocus");
      state.step = limit(step, 0, field.disparities.length - 1);
    }
    draw();
  }

  function setView(row, column) {
    if (!field) return;
    setMode("view");
    // Views beyond the pupil show nothing: the nearest one within it.
    let best = Infinity;
    for (let j = 0; j < field.v.length; j++) {
      for (let i = 0; i < field.u.length; i++) {
        const apart = (j - row) ** 2 + (i - column) ** 2;
        if (field.seen[j * field.u.length + i] && apart < best) [best, state.view] = [apart, [j, i]];
      }
    }
    draw();
  }

  function focusOn(row, column) {
    state.bin = [row, column];
    if (state.mode === "planes") {
      state.plane = sharpestPlane(planes, row, column) ?? state.plane;
    } else if (field && !field.fixed) {
      const known = depth ? depth.values[row * depth.columns + column] : NaN;
      const step = Number.isNaN(known)
        ? agreedStep(fields[state.source === 1 ? 1 : 0], row, column)
        : nearest(field.distances, known > 0 ? 1 / known : "inf");
      setMode("refocus");
      if (step !== null) state.step = step;
    }
    const raw = raws[0];
    if (raw && raw.bins && state.mode !== "planes") {
      const { offset, spacing } = raw.bins;
      setLens(offset[0] + column * spacing[0], offset[1] + row * spacing[1]);
    }
    draw();
  }

  // Drag, or click.
  const canvas = find("field");
  let held = null;
  canvas.addEventListener("pointerdown", (event) => {
    held = { x: event.clientX, y: event.clientY, view: [...state.view], moved: false };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held) return;
    const [x, y] = [event.clientX - held.x, event.clientY - held.y];
    if (!held.moved && Math.hypot(x, y) < 5) return;
    held.moved = true;
    if (!field) return;
    const box = canvas.getBoundingClientRect();
    setView(held.view[0] + y / box.height * field.v.length, held.view[1] + x / box.width * field.u.length);
  });
  canvas.addEventListener("pointerup", (event) => {
    if (held && !held.moved) {
      const [x, y] = inside(event, canvas);
      const { rows, columns } = state.picture;
      focusOn(limit(Math.floor(y * rows), 0, rows - 1), limit(Math.floor(x * columns), 0, columns - 1));
    }
    held = null;
  });
  canvas.addEventListener("pointercancel", () => { held = null; });

  function keys(target, actions) {
    target.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || !actions[event.key]) return;
      event.preventDefault();
      actions[event.key]();
    });
  }

  // Through views beyond the pupil, on to the next one.
  function moveView(down, across) {
    const [from, to] = [state.view, [state.view[0] + down, state.view[1] + across]];
    if (to[0] >= 0 && to[1] >= 0 && to[0] < field.v.length && to[1] < field.u.length) setView(...to);
    else setView(...from);
  }
  const arrows = (move) => ({
    ArrowLeft: () => move(0, -1),
    ArrowRight: () => move(0, 1),
    ArrowUp: () => move(-1, 0),
    ArrowDown: () => move(1, 0),
  });
  const currentStep = () => (state.mode === "planes" ? state.plane : state.step);
  keys(canvas, {
    ...(field && arrows(moveView)),
    "+": () => setStep(currentStep() + 1),
    "=": () => setStep(currentStep() + 1),
    "-": () => setStep(currentStep() - 1),
  });
  find("focus").addEventListener("input", (event) => setStep(Number(event.target.value)));
  find("exposure").addEventListener("input", (event) => { state.stops = Number(event.target.value); draw(); });

  // The viewpoint on the pupil.

  const pupil = find("pupil");
  const cell = () => pupil.width / Math.max(field.u.length, field.v.length);
  function drawPupil() {
    if (!field) return;
    const context = pupil.getContext("2d");
    const size = cell();
    context.clearRect(0, 0, pupil.width, pupil.height);
    for (let j = 0; j < field.v.length; j++) {
      for (let i = 0; i < field.u.length; i++) {
        const here = state.view[0] === j && state.view[1] === i;
        const used = state.mode === "refocus" || here ? "#ffb000" : "#778";
        context.fillStyle = field.seen[j * field.u.length + i] ? used : "#222";
        context.fillRect(i * size + 1, j * size + 1, Math.max(1, size - 2), Math.max(1, size - 2));
      }
    }
    find("view-text").textContent = state.mode === "view"
      ? `View ${state.view[1] + 1}, ${state.view[0] + 1} of ${field.u.length} x ${field.v.length} (across, down)`
      : state.mode === "refocus" ? "All views, shifted and added" : "";
  }
  const point = (event) => {
    const [x, y] = inside(event, pupil);
    setView(Math.floor(y * pupil.height / cell()), Math.floor(x * pupil.width / cell()));
  };
  pupil.addEventListener("pointerdown", (event) => { pupil.setPointerCapture(event.pointerId); point(event); });
  pupil.addEventListener("pointermove", (event) => { if (event.buttons) point(event); });
  if (field) keys(pupil, arrows(moveView));
  find("pupil-panel").hidden = !field;

  // The raw picture, and some of its micro-images enlarged.

  const anyRaw = raws.find(Boolean);
  const OVERVIEW = 640;

  // Values of a part of a raw picture, scaled to a size.
  function rawValues(raw, x, y, width, height, columns, rows) {
    const bytes = pixels(raw.image, x, y, width, height, columns, rows);
    const channels = raw.picture.channels;
    const values = new Float32Array(rows * columns * channels);
    for (let k = 0; k < rows * columns; k++) {
      for (let c = 0; c < channels; c++) {
        values[k * channels + c] = bytes[4 * k + 3] ? raw.value[bytes[4 * k + c]] : NaN;
      }
    }
    return { rows, columns, channels, values };
  }

  function drawPart(target, ...part) {
    if (state.source === "difference" && raws[0] && raws[1]) {
      paint(target, minus(rawValues(raws[1], ...part), rawValues(raws[0], ...part)), byDifference(white() / 4));
    } else {
      paint(target, rawValues(raws[state.source === 1 ? 1 : 0] || anyRaw, ...part), byExposure(white()));
    }
  }

  let overview = "";
  function drawRaw() {
    if (!anyRaw) return;
    const { rows, columns, factor, lenses } = anyRaw;
    const scale = Math.min(1, OVERVIEW / Math.max(rows, columns));
    const key = `${state.source} ${state.stops}`;
    if (overview !== key) {
      overview = key;
      const [width, height] = [columns, rows].map((size) => Math.max(1, Math.round(size * scale)));
      drawPart(find("raw"), 0, 0, columns, rows, width, height);
    }
    const across = Number(find("span").value);
    const pitch = lenses ? lenses.pitch / factor : Math.min(rows, columns) / 20;
    const size = Math.max(2, Math.round(across * pitch));
    const [x, y] = [state.lens.x / factor, state.lens.y / factor];
    const [left, top] = [Math.round(x - size / 2), Math.round(y - size / 2)];
    drawPart(find("lens"), left, top, size, size, size, size);
    const place = (name, [x0, y0, width, height], [wide, high]) => Object.assign(find(name).style, {
      left: `${100 * x0 / wide}%`,
      top: `${100 * y0 / high}%`,
      width: `${100 * width / wide}%`,
      height: `${100 * height / high}%`,
    });
    place("window", [left, top, size, size], [columns, rows]);
    place("ring", [x - left - pitch / 2, y - top - pitch / 2, pitch, pitch], [size, size]);
    find("span-text").textContent = `${across} (${size * factor} px)`;
    const where = `pixel ${state.lens.x.toFixed(1)}, ${state.lens.y.toFixed(1)}`;
    find("lens-text").textContent = state.lens.row === undefined
      ? `Middle at ${where}`
      : `Lens ${state.lens.column}, ${state.lens.row} (column, row from 0), centre at ${where}`;
  }

  function centre(row, column) {
    const { spacing, offset, rotation, shifted } = anyRaw.lenses;
    const along = (column + (shifted !== null && row % 2 === shifted ? 0.5 : 0)) * spacing[0];
    const down = row * spacing[1];
    const [cosine, sine] = [Math.cos(rotation), Math.sin(rotation)];
    return { row, column, x: offset[0] + cosine * along - sine * down, y: offset[1] + sine * along + cosine * down };
  }

  // The lens whose micro-image is nearest to a pixel of the whole raw picture.
  function setLens(x, y) {
    const grid = anyRaw.lenses;
    if (!grid) { state.lens = { x, y }; return; }
    const [cosine, sine] = [Math.cos(grid.rotation), Math.sin(grid.rotation)];
    const [right, below] = [x - grid.offset[0], y - grid.offset[1]];
    const guess = [(cosine * below - sine * right) / grid.spacing[1], (cosine * right + sine * below) / grid.spacing[0]];
    let best = Infinity;
    for (let row = Math.round(guess[0]) - 1; row <= guess[0] + 1.5; row++) {
      for (let column = Math.round(guess[1]) - 1; column <= guess[1] + 1.5; column++) {
        const one = centre(limit(row, 0, grid.shape[0] - 1), limit(column, 0, grid.shape[1] - 1));
        const apart = Math.hypot(one.x - x, one.y - y);
        if (apart < best) [best, state.lens] = [apart, one];
      }
    }
  }

  if (anyRaw) {
    const { rows, columns, factor, lenses } = anyRaw;
    setLens(factor * columns / 2, factor * rows / 2);
    const raw = find("raw");
    const choose = (event) => {
      const [x, y] = inside(event, raw);
      setLens(x * columns * factor, y * rows * factor);
      draw();
    };
    raw.addEventListener("pointerdown", (event) => { raw.setPointerCapture(event.pointerId); choose(event); });
    raw.addEventListener("pointermove", (event) => { if (event.buttons) choose(event); });
    keys(raw, arrows((down, across) => {
      const { row, column, x, y } = state.lens;
      if (lenses) {
        const [last, rightmost] = [lenses.shape[0] - 1, lenses.shape[1] - 1];
        state.lens = centre(limit(row + down, 0, last), limit(column + across, 0, rightmost));
      } else {
        setLens(limit(x + across * factor, 0, columns * factor), limit(y + down * factor, 0, rows * factor));
      }
      draw();
    }));
    find("span").addEventListener("input", draw);
  }
  find("raw-panel").hidden = !anyRaw;

  // Begin with the middle view, in focus.
  choices("modes", Object.entries(modes), null, (mode) => { setMode(mode); draw(); });
  const sources = data.recordings.map((one, index) => [index, one.name]);
  if (fields.length > 1) sources.push(["difference", "Difference"]);
  choices("sources", sources, 0, (source) => { state.source = source; draw(); });
  if (field) {
    const middle = field.disparities.map(Math.abs);
    state.step = middle.indexOf(Math.min(...middle));
    setView((field.v.length - 1) / 2, (field.u.length - 1) / 2);
  } else {
    state.plane = Math.floor(planes.length / 2);
    setMode(Object.keys(modes)[0]);
    draw();
  }
  find("field-hint").textContent = [
    field && "Drag, or press the arrow keys, to move the viewpoint.",
    (planes.length || (field && !field.fixed)) && "Click on what is to be in focus, or press + and -.",
    field && field.fixed && `Not refocused: ${field.fixed}.`,
    "Hatched: unknown.",
  ].filter(Boolean).join(" ");
  new ResizeObserver(() => state.picture && drawBin()).observe(canvas);
  // After the first frame, which draws the pictures and their texts.
  requestAnimationFrame(() => find("main").removeAttribute("aria-busy"));
}

start().catch((error) => {
  find("field-hint").textContent = `The pictures of this page cannot be read: ${error.message || error}`;
});
