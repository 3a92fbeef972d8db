// The vent button and the space bar. They need neither the page's framework nor the other scripts;
// where no script runs at all, the button still sends its form.
"use strict";
(() => {
  const PRESS = 1000; // ms after a press during which the click that ends it is no second press
  const find = (id) => document.getElementById(id);
  const button = find("vent"), notice = find("vent-notice");
  let pressed = -Infinity, hiding = 0;

  async function vent() {
    let good = false, text;
    button.classList.add("sent");
    try {
      const answer = await fetch("/vent", { method: "POST", signal: AbortSignal.timeout(4000) });
      const result = answer.ok ? await answer.json() : { message: await answer.text() };
      good = result.success === true;
      text = `${good ? "Vented" : "VENT FAILED"}: ${result.message}`;
    } catch (error) {
      text = `VENT FAILED: the page's server does not answer (${error.message}). Close the supply by hand.`;
    }
    button.classList.remove("sent");
    notice.textContent = text;
    notice.className = good ? "good" : "";
    notice.hidden = false;
    clearTimeout(hiding);
    hiding = setTimeout(() => { notice.hidden = true; }, good ? 4000 : 30000);
  }

  // When the button is pressed, not when it is let go.
  button.addEventListener("pointerdown", (event) => {
    event.preventDefault();
    pressed = performance.now();
    vent();
  });
  // The Enter key, screen readers and switches click without a pointer.
  button.addEventListener("click", (event) => {
    event.preventDefault();
    if (event.detail === 0 || performance.now() - pressed > PRESS) vent();
  });

  // Whether a space belongs to a text that is being written; no number has one.
  function typing(element) {
    if (!element || element.isContentEditable || element.tagName === "TEXTAREA") return !!element;
    return element.tagName === "INPUT" && ["text", "search"].includes(element.type)
      && !["decimal", "numeric"].includes(element.inputMode) && !element.readOnly;
  }

  // Before any other key handler, so that a space bar vents even where a button has the focus.
  for (const kind of ["keydown", "keyup"]) {
    window.addEventListener(kind, (event) => {
      if (event.code !== "Space" || typing(event.target)) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      if (kind === "keydown" && !event.repeat) vent();
    }, true);
  }
  const sayKey = () => {
    find("vent-key").textContent = typing(document.activeElement) ? "press here: typing" : "space bar";
  };
  for (const kind of ["focusin", "focusout"]) document.addEventListener(kind, () => setTimeout(sayKey));
})();
