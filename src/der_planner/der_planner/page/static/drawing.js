// Draws on the picture with mouse or finger, and shows what the server says about the drawing.
"use strict";
page.drawing = (() => {
  const INSIDE = "#ffffff", OUTSIDE = "#ff4040";
  const REGION_INTERVAL = 1000; // ms: the reachable region moves in the picture only with the camera
  const { find, seconds, drawLine } = page;
  let on = false, clean = true, points = [], pointer = null;
  let load = "", region = null, preview = null, begun = 0;
  const canvas = () => find("drawing");

  function pathOf(outlines) {
    const path = new Path2D();
    for (const outline of outlines) {
      outline.forEach(([x, y], index) => (index ? path.lineTo(x, y) : path.moveTo(x, y)));
      path.closePath();
    }
    return path;
  }

  function draw() {
    const target = canvas(), [width, height] = page.pictureSize || [1280, 720];
    if (!target || (!on && clean)) return; // what is drawn anew is composed anew, also where nothing is seen
    if (target.width !== width || target.height !== height) { target.width = width; target.height = height; }
    const context = target.getContext("2d");
    context.clearRect(0, 0, width, height);
    clean = !on;
    if (!on) return;
    const reachable = region && pathOf(region);
    if (reachable) { context.fillStyle = "rgba(60, 200, 255, .28)"; context.fill(reachable); }
    // Each piece in the colour of where it lies.
    for (let k = 1; k < points.length; k += 1) {
      const inside = !reachable || context.isPointInPath(reachable, ...points[k]);
      drawLine(context, [points[k - 1], points[k]], { colour: inside ? INSIDE : OUTSIDE, width: 4 });
    }
    for (const [x, y] of preview?.place || []) { // where the drawing cannot be followed
      context.strokeStyle = OUTSIDE;
      context.lineWidth = 5;
      context.beginPath();
      context.arc(x, y, 22, 0, 2 * Math.PI);
      context.stroke();
    }
    if (!preview || !preview.path.length) return;
    drawLine(context, preview.path, { colour: "#ffe14a", width: 3, dash: [9, 6] });
    const share = ((seconds() - begun) / Math.max(preview.duration, 1)) % 1;
    const pose = preview.poses[Math.floor(share * preview.poses.length)];
    if (pose) drawLine(context, pose, { colour: "rgba(255, 255, 255, .75)", width: 10 });
  }

  function pixel(event) {
    const target = canvas(), box = target.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width, y = (event.clientY - box.top) / box.height;
    return [x * target.width, y * target.height];
  }

  function begin(event) {
    if (!on || event.target !== canvas() || pointer !== null || event.button > 0) return;
    event.preventDefault();
    pointer = event.pointerId;
    event.target.setPointerCapture(pointer);
    points = [pixel(event)];
    preview = null;
  }

  function go(event) {
    if (event.pointerId !== pointer) return;
    const all = event.getCoalescedEvents?.() || [];
    for (const part of all.length ? all : [event]) points.push(pixel(part));
  }

  function end(event) {
    if (event.pointerId !== pointer) return;
    pointer = null;
    if (event.type !== "pointerup") points = [];
    // Tenths of a pixel of the camera's picture are finer than any hand.
    const rounded = points.map((point) => point.map((value) => Math.round(value * 10) / 10));
    emitEvent("drawn", { points: rounded });
  }

  async function askForRegion() {
    if (!on || document.hidden) return;
    const asked = load;
    const answer = await fetch(`/region?${asked}`, { signal: AbortSignal.timeout(30000) });
    if (answer.ok && asked === load) region = await answer.json();
  }

  document.addEventListener("pointerdown", begin);
  document.addEventListener("pointermove", go);
  document.addEventListener("pointerup", end);
  document.addEventListener("pointercancel", end);
  setInterval(() => { if (!document.hidden) draw(); }, 60);
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
    get preview() { return preview; },
    clear() { points = []; preview = null; },
    turn(wanted) {
      on = wanted;
      canvas()?.classList.toggle("on", on);
      find("draw-legend")?.toggleAttribute("hidden", !on);
      if (!on) this.clear();
    },
    // What is reachable depends on the load: it is asked for anew, and not shown as if it held meanwhile.
    setLoad(wanted) {
      const next = new URLSearchParams(wanted).toString();
      if (next !== load) { load = next; region = null; }
    },
    show(found) {
      preview = found;
      begun = seconds();
      if (!points.length || pointer === null) points = found.drawn;
    },
  };
})();
