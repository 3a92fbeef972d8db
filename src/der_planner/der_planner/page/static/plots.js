// The last 30 s as curves on plain canvases.
"use strict";
(() => {
  const SPAN = 30; // s
  const COLOURS = ["#2367c9", "#d2601a", "#3c8a3c", "#8a3c8a"]; // of the segments
  const LEFT = 38, TOP = 8, BOTTOM = 6; // px around the curves
  const samples = [];

  page.onData.push(({ driver, limb, sources }) => {
    const now = page.seconds();
    const heard = sources.driver.fresh ? driver : null;
    const seen = sources.tracker.fresh && limb?.valid ? limb : null;
    samples.push({
      at: now,
      measured: heard?.measured_kpa,
      commanded: heard?.commanded_kpa,
      bend: seen?.bend_deg,
      error: seen && [seen.error_cm],
    });
    while (now - samples[0].at > SPAN) samples.shift();
    if (document.hidden) return;
    plot("plot-pressure", now, ["measured", "commanded"], 1);
    plot("plot-bend", now, ["bend"], 5);
    plot("plot-error", now, ["error"], 0.2);
  });

  // Draws quantities on a scale that spans `least` or more: the first as lines, the second as dots.
  function plot(id, now, quantities, least) {
    const canvas = page.find(id);
    if (!canvas) return;
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const all = samples.flatMap((sample) => quantities.flatMap((name) => sample[name] || []));
    const known = all.filter((value) => value !== null);
    let low = Math.min(...known, 0), high = Math.max(...known, 0);
    const missing = Math.max(0, least - (high - low));
    if (low < 0) low -= missing / 2;
    high += low < 0 ? missing / 2 : missing;
    const x = (at) => LEFT + ((at - now + SPAN) / SPAN) * (width - LEFT);
    const y = (value) => height - BOTTOM - ((value - low) / (high - low)) * (height - TOP - BOTTOM);
    context.fillStyle = "#44505c";
    context.strokeStyle = "#dde2e7";
    context.font = "11px system-ui";
    context.lineWidth = 1;
    for (const value of [low, (low + high) / 2, high]) {
      const label = value.toFixed(high - low < 10 ? 1 : 0).replace(/^-(?=0(\.0+)?$)/, "");
      context.fillText(label, 2, y(value) + 4);
      context.beginPath();
      context.moveTo(LEFT, y(value));
      context.lineTo(width, y(value));
      context.stroke();
    }
    context.lineWidth = 1.6;
    quantities.forEach((name, dotted) => COLOURS.forEach((colour, segment) => {
      context.setLineDash(dotted ? [2, 3] : []);
      context.strokeStyle = colour;
      context.beginPath();
      let drawing = false;
      for (const sample of samples) {
        const value = sample[name]?.[segment] ?? null;
        if (value !== null) context[drawing ? "lineTo" : "moveTo"](x(sample.at), y(value));
        drawing = value !== null;
      }
      context.stroke();
    }));
    context.setLineDash([]);
  }
})();
