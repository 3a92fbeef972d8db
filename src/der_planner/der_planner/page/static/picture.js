// Fetches the camera's picture while somebody looks, and draws over it what belongs to it.
"use strict";
(() => {
  const LEAST = 30, TRAIL = 10000; // ms
  const wait = (time) => new Promise((done) => setTimeout(done, time));
  const SLOW = 0.4, QUICK = 0.1, COARSE = 320; // s on the way: pictures are asked for small where it takes long; px
  let number = 0, trail = [], coarse = false;
  page.pictures = 0;

  function line(context, points, colour, width, closed = false, dash = []) {
    if (points.length < 2) return;
    context.setLineDash(dash);
    context.beginPath();
    points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    if (closed) context.closePath();
    context.lineJoin = "round";
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke();
    context.setLineDash([]);
  }

  // Draws a picture and what belongs over it.
  function draw(canvas, image, over, tips) {
    // Everything is given in pixels of the camera, and drawn no finer than the window shows it.
    const [width, height] = over.size, scale = Math.min(1, shownWidth(canvas) / width);
    const across = Math.round(width * scale), down = Math.round(height * scale);
    if (canvas.width !== across || canvas.height !== down) { canvas.width = across; canvas.height = down; }
    const context = canvas.getContext("2d");
    context.setTransform(across / width, 0, 0, down / height, 0, 0);
    context.drawImage(image, 0, 0, width, height);
    line(context, over.path, "#30c060", 2.5);
    line(context, over.planned, "#9be8b4", 5);
    for (const tag of over.tags) line(context, [0, 2, 4, 6].map((i) => [tag[i], tag[i + 1]]), "#2e9bff", 2, true);
    line(context, over.curve, "#ff7828", 3);
    line(context, over.estimate, "#ff5fd0", 4, false, [10, 12]); // the measured limb shows in its gaps
    line(context, tips, "#ffd84a", 2);
    for (const [point, colour] of [[over.tip, "#ff7828"], [over.reference, "#30c060"]]) {
      if (!point) continue;
      context.beginPath();
      context.arc(point[0], point[1], 9, 0, 2 * Math.PI);
      context.strokeStyle = colour;
      context.lineWidth = 3;
      context.stroke();
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
  }

  const shownWidth = (canvas) => Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)) || 1280;

  function trailWith(tip) {
    const now = performance.now();
    trail = trail.filter((point) => now - point[2] < TRAIL);
    if (tip) trail.push([...tip, now]);
    return trail;
  }

  async function next() {
    const canvas = document.getElementById("picture");
    if (!canvas || document.hidden) return 300;
    const begin = performance.now();
    // The server answers when there is a newer picture, so that none waits to be asked for.
    const address = `/picture?after=${number}&wait=1&width=${coarse ? COARSE : shownWidth(canvas)}`;
    const answer = await fetch(address, { signal: AbortSignal.timeout(10000) });
    if (answer.status !== 200) return answer.status === 204 ? 0 : 1000;
    const body = await answer.arrayBuffer(), size = new DataView(body).getUint32(0);
    const over = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, size)));
    const image = await createImageBitmap(new Blob([new Uint8Array(body, 4 + size)], { type: "image/jpeg" }));
    number = over.number;
    page.pictureSize = over.size;
    page.pictureAt = begin / 1000 + over.waited;
    const way = performance.now() / 1000 - page.pictureAt;
    coarse = way > SLOW || (coarse && way > QUICK);
    draw(canvas, image, over, trailWith(over.tip));
    const note = document.getElementById("view-note");
    if (note && note.textContent !== over.problem) note.textContent = over.problem;
    image.close();
    page.pictures += 1;
    return Math.max(0, LEAST - (performance.now() - begin));
  }

  (async () => {
    for (;;) {
      let pause = 1000;
      try { pause = await next(); } catch (error) { number = 0; } // the banner says that the server is away
      await wait(pause);
    }
  })();
})();
