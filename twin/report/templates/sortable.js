for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
  const value = (row, column) => row.cells[column].textContent;
  const size = (text) => parseFloat(text.replace("−", "-").replace(/[<>,]/g, ""));
  const compared = (one, other, sign) => { // numbers by size and before words; what is not there comes last
    const a = size(one), b = size(other);
    if (isNaN(a) || isNaN(b)) return isNaN(a) - isNaN(b) || sign * one.localeCompare(other);
    return sign * (a - b);
  };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const sign = down ? -1 : 1;
      body.append(...[...body.rows].sort((a, b) => compared(value(a, column), value(b, column), sign)));
    });
  });
}
