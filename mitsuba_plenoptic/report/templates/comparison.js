"use strict";

const data = JSON.parse(document.getElementById("data").textContent);

// The captures: a swipe between rays and waves, with zoom. The state is the swipe in per cent, the zoom (1: all in
// view) and the place of the picture, in fractions of it, that is in the middle of the view.
(() => {
  const viewer = document.getElementById("viewer");
  const pictures = viewer.querySelectorAll("img");
  const swipe = document.getElementById("swipe");
  const bar = viewer.querySelector(".ruler i");
  const barText = viewer.querySelector(".ruler span");
  const { width, height, pixel, regions } = data.capture;
  const state = { zoom: 1, x: 0.5, y: 0.5 };
  const limit = (value, low, high) => Math.min(Math.max(value, low), high);
  const fit = () => Math.min(viewer.clientWidth / width, viewer.clientHeight / height);

  function draw() {
    const scale = fit() * state.zoom;
    const place = { x: 0, y: 0 };
    for (const [axis, view, size] of [["x", viewer.clientWidth, width], ["y", viewer.clientHeight, height]]) {
      const long = size * scale;
      const half = view / (2 * long);
      state[axis] = long > view ? limit(state[axis], half, 1 - half) : 0.5;
      place[axis] = view / 2 - state[axis] * long;
    }
    for (const picture of pictures) {
      picture.style.width = `${width * scale}px`;
      picture.style.height = `${height * scale}px`;
      picture.style.transform = `translate(${place.x}px, ${place.y}px)`;
    }
    viewer.classList.toggle("zoomed", state.zoom > 1.001);
    viewer.classList.toggle("close", scale > 2);
    viewer.style.setProperty("--swipe", `${swipe.value}%`);
    const millimetre = scale / pixel;
    const widest = 0.3 * viewer.clientWidth;
    const length = [5, 2, 1, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005].find((step) => step * millimetre < widest) || 0.002;
    bar.style.width = `${length * millimetre}px`;
    barText.textContent = `${length} mm`;
  }

  // Zoom about a point of the view, given in fractions of it from its middle.
  function zoomBy(factor, atX = 0, atY = 0) {
    const before = fit() * state.zoom;
    state.zoom = limit(state.zoom * factor, 1, 24 / fit());
    const after = fit() * state.zoom;
    state.x += atX * viewer.clientWidth * (1 / before - 1 / after) / width;
    state.y += atY * viewer.clientHeight * (1 / before - 1 / after) / height;
    draw();
  }

  function moveBy(x, y) {
    const scale = fit() * state.zoom;
    state.x += x / (scale * width);
    state.y += y / (scale * height);
    draw();
  }

  function show(region) {
    Object.assign(state, region ? { x: region.x, y: region.y } : { x: 0.5, y: 0.5 });
    const shorter = Math.min(viewer.clientWidth, viewer.clientHeight);
    state.zoom = region ? Math.max(1, shorter / (region.size * width * fit())) : 1;
    draw();
  }

  const inView = (event) => {
    const box = viewer.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };

  const touches = new Map();
  viewer.addEventListener("pointerdown", (event) => {
    touches.set(event.pointerId, event);
    viewer.setPointerCapture(event.pointerId);
    if (touches.size === 1 && state.zoom <= 1.001) { swipe.value = 100 * inView(event)[0]; draw(); }
  });
  viewer.addEventListener("pointermove", (event) => {
    const before = touches.get(event.pointerId);
    if (!before) return;
    if (touches.size === 2) {
      const [other] = [...touches.values()].filter((touch) => touch.pointerId !== event.pointerId);
      const apart = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      const [x, y] = inView(other);
      zoomBy(apart(event) / Math.max(1, apart(before)), x - 0.5, y - 0.5);
    } else if (state.zoom > 1.001) {
      moveBy(before.clientX - event.clientX, before.clientY - event.clientY);
    } else {
      swipe.value = 100 * inView(event)[0];
      draw();
    }
    touches.set(event.pointerId, event);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    viewer.addEventListener(name, (event) => touches.delete(event.pointerId));
  }
  viewer.addEventListener("wheel", (event) => {
    // Without these the wheel belongs to the page.
    if (!event.ctrlKey && !event.metaKey && document.activeElement !== viewer) return;
    event.preventDefault();
    const [x, y] = inView(event);
    zoomBy(Math.exp(-event.deltaY / 300), x - 0.5, y - 0.5);
  }, { passive: false });

  const step = 60;
  const keys = {
    ArrowLeft: () => moveBy(-step, 0),
    ArrowRight: () => moveBy(step, 0),
    ArrowUp: () => moveBy(0, -step),
    ArrowDown: () => moveBy(0, step),
    "+": () => zoomBy(1.4),
    "=": () => zoomBy(1.4),
    "-": () => zoomBy(1 / 1.4),
    0: () => show(null),
  };
  viewer.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
    event.preventDefault();
    keys[event.key]();
  });

  swipe.addEventListener("input", draw);
  document.getElementById("closer").addEventListener("click", () => zoomBy(1.6));
  document.getElementById("farther").addEventListener("click", () => zoomBy(1 / 1.6));
  document.getElementById("whole").addEventListener("click", () => show(null));
  for (const button of document.querySelectorAll("[data-region]")) {
    button.addEventListener("click", () => show(regions[Number(button.dataset.region)]));
  }
  new ResizeObserver(draw).observe(viewer);
  draw();
})();

// Refocusing: a slider over distances and a choice of methods.
(() => {
  const picture = document.getElementById("refocused");
  const slider = document.getElementById("distance");
  const output = document.getElementById("distance-text");
  const facts = document.getElementById("facts");
  const { distances, images, facts: numbers } = data.refocus;

  function draw() {
    const choice = document.querySelector("input[name=method]:checked");
    const distance = distances[Number(slider.value)];
    const title = choice.parentElement.textContent.trim();
    picture.src = images[choice.value][distance];
    picture.alt = `${title}, refocused to ${distance}`;
    output.textContent = distance;
    slider.setAttribute("aria-valuetext", distance);
    facts.replaceChildren();
    for (const [name, value] of (numbers[choice.value] || {})[distance] || []) {
      facts.append(Object.assign(document.createElement("dt"), { textContent: name }));
      facts.append(Object.assign(document.createElement("dd"), { textContent: value }));
    }
  }

  slider.addEventListener("input", draw);
  for (const choice of document.querySelectorAll("input[name=method]")) choice.addEventListener("change", draw);
  draw();
})();
