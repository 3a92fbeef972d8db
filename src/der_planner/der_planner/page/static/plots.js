// Fills the curves of the last 30 s: which there are, and their names, the window has said.
"use strict";
(() => {
  const SPAN = 30; // s
  const PAUSE = 0.25; // s between two drawings: more is not seen, and costs
  const samples = [];
  let drawn = -Infinity;

  page.onData.push(({ driver, limb, sources }) => {
    const now = page.seconds();
    const heard = sources.driver.fresh ? driver : null;
    const seen = sources.tracker.fresh && limb?.valid ? limb : null;
    samples.push({
      at: now,
      pressure: heard && [...heard.measured_kpa, ...heard.commanded_kpa],
      bend: seen?.bend_deg,
      error: seen && [seen.error_cm],
    });
    while (now - samples[0].at > SPAN) samples.shift();
    if (document.hidden || now - drawn < PAUSE || !page.curves || !window.did_handshake) return;
    drawn = now;
    for (const [name, element] of Object.entries(page.curves)) fill(name, getElement(element)?.chart, now);
  });

  function fill(name, chart, now) {
    if (!chart) return;
    const count = chart.getOption().series.length;
    const series = Array.from({ length: count }, (_, index) => ({
      // A gap where nothing was known, and not a line across it.
      data: samples.map((sample) => [
        Math.round(100 * (sample.at - now)) / 100, sample[name]?.[index] ?? null,
      ]),
    }));
    chart.setOption({ series });
  }
})();
