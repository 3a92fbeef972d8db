// Replays a bag: the slider's instant decides what the picture and the curves show.
"use strict";
page.replay = (() => {
  const INTERVAL = 66, SPAN = 30; // ms between two pictures at most; s of the curves
  const bag = new URLSearchParams(location.search).get("bag") || "";
  const find = (id) => document.getElementById(id);
  const put = (id, text) => { const element = find(id); if (element && element.textContent !== text) element.textContent = text; };
  const wait = (time) => new Promise((done) => setTimeout(done, time));
  let data = null, at = 0, playing = false, last = 0, shown = null, problem = bag ? "Opening the bag …" : "";
  const state = { frames: 0, get at() { return at; }, get shown() { return shown; }, get ready() { return !!data; } };

  function clockText(seconds) {
    const minutes = Math.floor(seconds / 60);
    return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
  }

  // The index of the newest entry not after an instant; -1 before the first.
  function newest(times, instant) {
    let low = 0, high = times.length;
    while (low < high) { const middle = (low + high) >> 1; if (times[middle] <= instant) low = middle + 1; else high = middle; }
    return low - 1;
  }

  function show() {
    put("replay-note", [problem, data ? data.notes.join(" ") : ""].filter(Boolean).join(" "));
    if (!data) return;
    put("replay-recorded", `recorded ${data.recorded}, ${data.bag}`);
    put("replay-about", data.about);
    put("replay-time", `${clockText(at)} of ${clockText(data.duration)}`);
    put("replay-play", playing ? "Pause" : "Play");
    const slider = find("replay-slider");
    if (slider) {
      slider.max = data.duration;
      slider.disabled = find("replay-play").disabled = false;
      if (document.activeElement !== slider || playing) slider.value = at;
      slider.setAttribute("aria-valuetext", clockText(at));
    }
    const mode = data.driver.modes[newest(data.driver.modes.map((entry) => entry[0]), at)];
    put("replay-mode", mode ? `driver then: ${mode[1]}${mode[2] ? `, ${mode[2]}` : ""}` : "no driver then");
    curves();
  }

  function curves() {
    const samples = [], { driver, limb } = data, from = at - SPAN;
    for (let k = Math.max(0, newest(driver.at, from)); k < driver.at.length && driver.at[k] <= at; k += 1)
      samples.push({ at: driver.at[k], measured: driver.measured[k], commanded: driver.commanded[k] });
    const seen = [];
    for (let k = Math.max(0, newest(limb.at, from)); k < limb.at.length && limb.at[k] <= at; k += 1)
      seen.push({ at: limb.at[k], bend: limb.bend[k], error: limb.error[k] });
    page.plotCurves(samples, seen, at);
    const p = driver.measured[newest(driver.at, at)], k = newest(limb.at, at), b = limb.bend[k], e = limb.error[k];
    const list = (values, unit) => (values ? `${values.map((value) => (value === null ? "?" : value.toFixed(1))).join(" / ")} ${unit}` : `? ${unit}`);
    put("replay-values", `Then: ${list(p, "kPa")} · ${list(b, "°")} · tip error ${e ? `${e[0].toFixed(2)} cm` : "?"}`);
  }

  async function draw() {
    const canvas = find("replay-picture");
    if (!canvas || !data || shown === at) return;
    const wanted = at;
    const answer = await fetch(`/replay/frame?bag=${encodeURIComponent(bag)}&at=${wanted}`, { signal: AbortSignal.timeout(20000) });
    if (!answer.ok) { problem = await answer.text(); shown = wanted; return; }
    const body = await answer.arrayBuffer(), size = new DataView(body).getUint32(0);
    const over = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, size)));
    const jpeg = new Uint8Array(body, 4 + size);
    const image = jpeg.length ? await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })) : null;
    page.drawOver(canvas, image, over, over.trail);
    stamp(canvas);
    image?.close();
    problem = over.problem;
    shown = wanted;
    state.frames += 1;
  }

  // In the picture itself, so that a screenshot of it cannot be taken for live either.
  function stamp(canvas) {
    const context = canvas.getContext("2d"), size = Math.round(canvas.height / 14);
    context.font = `bold ${size}px system-ui`;
    context.lineWidth = size / 8;
    context.strokeStyle = "#000";
    context.fillStyle = "#c9a6ff";
    const text = `REPLAY ${clockText(at)}`;
    context.strokeText(text, size / 2, size * 1.2);
    context.fillText(text, size / 2, size * 1.2);
  }

  function go(instant) { at = Math.min(Math.max(instant, 0), data.duration); show(); }

  document.addEventListener("input", (event) => { if (event.target.id === "replay-slider" && data) { go(Number(event.target.value)); } });
  document.addEventListener("click", (event) => {
    if (event.target.id !== "replay-play" || !data) return;
    playing = !playing;
    if (playing && at >= data.duration) at = 0;
    last = performance.now();
    show();
  });

  setInterval(() => {
    const now = performance.now();
    if (playing && data) {
      const speed = Number(find("replay-speed")?.value || 1);
      at = Math.min(at + (speed * (now - last)) / 1000, data.duration);
      if (at >= data.duration) playing = false;
    }
    last = now;
    if (!document.hidden) show();
  }, 100);

  (async () => {
    if (!bag) return;
    try {
      const answer = await fetch(`/replay/data?bag=${encodeURIComponent(bag)}`);
      if (answer.ok) { data = await answer.json(); problem = ""; } else problem = await answer.text();
    } catch (error) { problem = `The page's server does not answer (${error.message}).`; }
    show();
    for (;;) {
      const begin = performance.now();
      try { if (!document.hidden) await draw(); } catch (error) { problem = `No picture: ${error.message}`; await wait(1000); }
      await wait(Math.max(10, INTERVAL - (performance.now() - begin)));
    }
  })();
  return state;
})();
