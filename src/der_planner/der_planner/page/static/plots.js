// The last 30 s as curves on plain canvases.
"use strict";
(() => {
  const SPAN = 30, COLOURS = ["#2367c9", "#d2601a", "#3c8a3c", "#8a3c8a"];
  const samples = [];

  page.listeners.push((data) => {
    const now = performance.now() / 1000, { driver, limb, sources } = data;
    const heard = sources.driver.fresh ? driver : null, seen = sources.tracker.fresh && limb && limb.valid ? limb : null;
    samples.push({ at: now, measured: heard?.measured_kpa, commanded: heard?.commanded_kpa, bend: seen?.bend_deg, error: seen ? [seen.error_cm] : null });
    while (samples.length && now - samples[0].at > SPAN) samples.shift();
    if (document.hidden) return;
    plot("plot-pressure", now, [["measured", false], ["commanded", true]], 1);
    plot("plot-bend", now, [["bend", false]], 5);
    plot("plot-error", now, [["error", false]], 0.2, 0);
  });

  function plot(id, now, curves, least, floor = null) {
    const canvas = document.getElementById(id);
    if (!canvas) return;
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const all = samples.flatMap((sample) => curves.flatMap(([name]) => sample[name] || [])).filter((value) => value !== null);
    let low = floor ?? Math.min(...all, 0), high = Math.max(...all, 0);
    if (high - low < least) { high += (least - (high - low)) / (floor === null ? 2 : 1); if (floor === null) low = high - least; }
    const left = 38, x = (at) => left + ((at - now + SPAN) / SPAN) * (width - left), y = (value) => height - 6 - ((value - low) / (high - low)) * (height - 14);
    context.fillStyle = "#44505c";
    context.strokeStyle = "#dde2e7";
    context.font = "11px system-ui";
    for (const value of [low, (low + high) / 2, high]) {
      context.fillText(value.toFixed(high - low < 10 ? 1 : 0).replace(/^-(?=0(\.0+)?$)/, ""), 2, y(value) + 4);
      context.beginPath(); context.moveTo(left, y(value)); context.lineTo(width, y(value)); context.stroke();
    }
    for (const [name, dashed] of curves) for (let part = 0; part < 4; part += 1) {
      context.beginPath();
      context.setLineDash(dashed ? [2, 3] : []);
      context.strokeStyle = COLOURS[part];
      context.lineWidth = 1.6;
      let drawing = false;
      for (const sample of samples) {
        const value = sample[name]?.[part];
        if (value === null || value === undefined) { drawing = false; continue; }
        drawing ? context.lineTo(x(sample.at), y(value)) : context.moveTo(x(sample.at), y(value));
        drawing = true;
      }
      context.stroke();
    }
    context.setLineDash([]);
    context.lineWidth = 1;
  }
})();
