"use strict";
/* What is packed on the page: gzip in base64. A browser of before 2023 may lack the reader and is told so. */
const unpacked = (async () => {
  const response = (id) => {
    const bytes = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip")));
  };
  const buffer = (id) => document.getElementById(id)?.textContent ? response(id).arrayBuffer() : null;
  const script = document.createElement("script");
  script.textContent = await response("plotly").text();
  document.head.appendChild(script);
  return { ...await response("data").json(), ct: await buffer("ct"), surfaces: await buffer("surfaces") };
})();
unpacked.catch((reason) => {
  document.getElementById("not-unpacked").hidden = false;
  console.error(reason);
});
