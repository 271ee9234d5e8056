"use strict";
/* What is packed on the page: gzip in base64. A browser of before 2023 may lack the reader and is told so. */
const unpacked = (async () => {
  const bytesOf = (id) => Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const response = (id) => new Response(new Blob([bytesOf(id)]).stream().pipeThrough(new DecompressionStream("gzip")));
  const buffer = (id) => document.getElementById(id)?.textContent ? response(id).arrayBuffer() : null;
  /* A lossy CT: JPEGs of slices below one another. Null where a browser alters what is read off a canvas. */
  async function pictured({ shape: [nx, ny, nz], rows, strips }) {
    const content = bytesOf("ct"), values = new Uint8Array(nx * ny * nz), canvas = document.createElement("canvas");
    const context = canvas.getContext("2d", { willReadFrequently: true });
    let at = 0, to = 0;
    for (const [bytes, slices, mean] of strips) {
      const blob = new Blob([content.subarray(at, at += bytes)], { type: "image/jpeg" });
      const picture = await createImageBitmap(blob, { colorSpaceConversion: "none" });
      Object.assign(canvas, { width: nx, height: rows * slices });
      context.drawImage(picture, 0, 0);
      const pixels = context.getImageData(0, 0, nx, rows * slices).data;
      let sum = 0;
      for (let k = 0; k < nx * rows * slices; k++) {
        sum += pixels[4 * k];
        if (Math.floor(k / nx) % rows < ny) values[to++] = pixels[4 * k];
      }
      if (!(Math.abs(sum / (nx * rows * slices) - mean) < 0.5)) return null;
    }
    return values;
  }
  const script = document.createElement("script");
  script.textContent = await response("plotly").text();
  document.head.appendChild(script);
  const data = await response("data").json(), facts = data.slices?.ct;
  return { ...data, ct: facts?.strips ? await pictured(facts) : await buffer("ct"), surfaces: await buffer("surfaces") };
})();
unpacked.catch((reason) => {
  document.getElementById("not-unpacked").hidden = false;
  console.error(reason);
});
