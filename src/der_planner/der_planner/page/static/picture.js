// Fetches the camera's picture while somebody looks, and draws over it what belongs to it.
"use strict";
page.pictures = 0;
// Draws a line through points; `style` has colour, width, and, where wanted, closed and dash.
page.drawLine = (context, points, { colour, width, closed = false, dash = [] }) => {
  if (points.length < 2) return;
  context.beginPath();
  points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
  if (closed) context.closePath();
  context.lineJoin = context.lineCap = "round";
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.stroke();
  context.setLineDash([]);
};
(() => {
  const LEAST = 30; // ms between two pictures
  const TRAIL = 10; // s of the tip's way that are drawn
  const SLOW = 0.4, QUICK = 0.1, COARSE = 320; // s on the way; px: where it takes long, pictures are small
  const { find, put, seconds, drawLine } = page;
  const wait = (time) => new Promise((done) => setTimeout(done, time));
  let number = 0, trail = [], coarse = false;

  const shownWidth = (canvas) => Math.round(canvas.clientWidth * (window.devicePixelRatio || 1)) || 1280;

  // Everything is given in pixels of the camera, and drawn no finer than the window shows it.
  function draw(canvas, image, over) {
    const [width, height] = over.size, scale = Math.min(1, shownWidth(canvas) / width);
    const across = Math.round(width * scale), down = Math.round(height * scale);
    if (canvas.width !== across || canvas.height !== down) { canvas.width = across; canvas.height = down; }
    const context = canvas.getContext("2d");
    context.setTransform(across / width, 0, 0, down / height, 0, 0);
    context.drawImage(image, 0, 0, width, height);
    drawLine(context, over.path, { colour: "#30c060", width: 2.5 });
    drawLine(context, over.planned, { colour: "#9be8b4", width: 5 });
    for (const tag of over.tags) {
      const corners = [0, 2, 4, 6].map((place) => [tag[place], tag[place + 1]]);
      drawLine(context, corners, { colour: "#2e9bff", width: 2, closed: true });
    }
    drawLine(context, over.curve, { colour: "#ff7828", width: 3 });
    // The measured limb shows in the estimate's gaps.
    drawLine(context, over.estimate, { colour: "#ff5fd0", width: 4, dash: [10, 12] });
    drawLine(context, trail, { colour: "#ffd84a", width: 2 });
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

  // Shows the next picture; returns how long to wait before the one after [ms].
  async function next() {
    const canvas = find("picture");
    if (!canvas || document.hidden) return 300;
    const begin = seconds();
    // The server answers when there is a newer picture, so that none waits to be asked for.
    const width = coarse ? COARSE : shownWidth(canvas);
    const address = `/picture?after=${number}&wait=1&width=${width}`;
    const answer = await fetch(address, { signal: AbortSignal.timeout(10000) });
    if (answer.status !== 200) return answer.status === 204 ? 0 : 1000;
    const body = await answer.arrayBuffer(), size = new DataView(body).getUint32(0);
    const over = JSON.parse(new TextDecoder().decode(new Uint8Array(body, 4, size)));
    const file = new Blob([new Uint8Array(body, 4 + size)], { type: "image/jpeg" });
    const image = await createImageBitmap(file);
    number = over.number;
    page.pictureSize = over.size;
    page.pictureAt = begin + over.waited;
    const way = seconds() - page.pictureAt;
    coarse = way > SLOW || (coarse && way > QUICK);
    trail = trail.filter((point) => begin - point[2] < TRAIL);
    if (over.tip) trail.push([...over.tip, begin]);
    draw(canvas, image, over);
    put(find("view-note"), over.problem);
    image.close();
    page.pictures += 1;
    return Math.max(0, LEAST - 1000 * (seconds() - begin));
  }

  (async () => {
    for (;;) {
      let pause = 1000;
      try { pause = await next(); } catch (error) { number = 0; } // the banner says that the server is away
      await wait(pause);
    }
  })();
})();
