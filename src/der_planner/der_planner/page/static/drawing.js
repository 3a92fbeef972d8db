// Draws on the picture with mouse or finger, and shows what the server says about the drawing.
"use strict";
page.drawing = (() => {
  const INSIDE = "#ffffff", OUTSIDE = "#ff4040";
  const REGION_INTERVAL = 1000; // ms: the reachable region moves in the picture only with the camera
  let load = "", region = null, on = false, clean = true, points = [], preview = null, begun = 0, pointer = null;
  const canvas = () => document.getElementById("drawing");

  function pathOf(outlines) {
    const path = new Path2D();
    for (const outline of outlines) {
      outline.forEach(([x, y], index) => (index ? path.lineTo(x, y) : path.moveTo(x, y)));
      path.closePath();
    }
    return path;
  }

  function line(context, list, colour, width, dash = []) {
    if (list.length < 2) return;
    context.beginPath();
    list.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.setLineDash(dash);
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.lineJoin = context.lineCap = "round";
    context.stroke();
    context.setLineDash([]);
  }

  function draw() {
    const target = canvas(), [width, height] = page.pictureSize || [1280, 720];
    if (!target || (!on && clean)) return; // what is drawn anew is composed anew, also where nothing is seen
    if (target.width !== width || target.height !== height) { target.width = width; target.height = height; }
    const context = target.getContext("2d");
    context.clearRect(0, 0, target.width, target.height);
    clean = !on;
    if (!on) return;
    const reachable = region ? pathOf(region) : null;
    if (reachable) { context.fillStyle = "rgba(60, 200, 255, .28)"; context.fill(reachable); }
    // Each piece in the colour of where it lies.
    for (let k = 1; k < points.length; k += 1) {
      const inside = !reachable || context.isPointInPath(reachable, points[k][0], points[k][1]);
      line(context, [points[k - 1], points[k]], inside ? INSIDE : OUTSIDE, 4);
    }
    if (!preview || !preview.path.length) return;
    line(context, preview.path, "#ffe14a", 3, [9, 6]);
    const share = ((performance.now() - begun) / 1000 / Math.max(preview.duration, 1)) % 1;
    const pose = preview.poses[Math.floor(share * preview.poses.length)];
    if (pose) line(context, pose, "rgba(255, 255, 255, .75)", 10);
  }

  function at(event) {
    const target = canvas(), box = target.getBoundingClientRect();
    return [((event.clientX - box.left) / box.width) * target.width, ((event.clientY - box.top) / box.height) * target.height];
  }

  function begin(event) {
    if (!on || event.target !== canvas() || pointer !== null || event.button > 0) return;
    event.preventDefault();
    pointer = event.pointerId;
    event.target.setPointerCapture(pointer);
    points = [at(event)];
    preview = null;
  }

  function go(event) {
    if (event.pointerId !== pointer) return;
    const all = event.getCoalescedEvents?.() || [];
    for (const part of all.length ? all : [event]) points.push(at(part));
  }

  function end(event) {
    if (event.pointerId !== pointer) return;
    pointer = null;
    // Whole pixels of the camera's picture over ten are finer than any hand.
    if (event.type === "pointerup") emitEvent("drawn", { points: points.map(([x, y]) => [Math.round(x * 10) / 10, Math.round(y * 10) / 10]) });
    else points = [];
  }

  document.addEventListener("pointerdown", begin);
  document.addEventListener("pointermove", go);
  document.addEventListener("pointerup", end);
  document.addEventListener("pointercancel", end);
  setInterval(() => { if (!document.hidden) draw(); }, 60);

  async function askForRegion() {
    if (!on || document.hidden) return;
    const asked = load;
    const answer = await fetch(`/region?${asked}`, { signal: AbortSignal.timeout(30000) });
    if (answer.ok && asked === load) region = await answer.json();
  }

  (async () => {
    for (;;) {
      try { await askForRegion(); } catch (error) { /* the banner says that the server is away */ }
      await new Promise((done) => setTimeout(done, on && !region ? 100 : REGION_INTERVAL));
    }
  })();

  return {
    get on() { return on; },
    get load() { return load; },
    get region() { return region; },
    // What is reachable depends on the load: it is asked for anew, and not shown as if it held meanwhile.
    setLoad(wanted) { const next = new URLSearchParams(wanted).toString(); if (next !== load) { load = next; region = null; } },
    get points() { return points; },
    get preview() { return preview; },
    turn(wanted) { on = wanted; canvas()?.classList.toggle("on", on); document.getElementById("draw-legend")?.toggleAttribute("hidden", !on); if (!on) { points = []; preview = null; } },
    clear() { points = []; preview = null; },
    show(found) { preview = found; begun = performance.now(); if (!points.length || pointer === null) points = found.drawn; },
  };
})();
