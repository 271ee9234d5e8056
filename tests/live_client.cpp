// A navigation program, for tests and the benchmark: it speaks to `run-twin live` through the OpenIGTLink library alone.
//
// live_client PORT ROUNDS X Y Z: each round moves the target (RAS, mm) by 0.01 mm along z, and asks about a needle that
// points at it from the front. Then a tracked needle is streamed at 50 Hz for a second, as TDATA. One line an answer:
//   map MS POINTS CELLS BLOCKED LEAST_STRUCTURE STAMP | grid COLUMNS ROWS FIRST | info JSON
//   verdict MS STAMP JSON, since the newest target or needle | entry COUNT X Y Z NAME | tracked SENT ANSWERS OLDEST_MS
#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <thread>
#include <vector>
#include <igtlClientSocket.h>
#include <igtlImageMessage.h>
#include <igtlMessageHeader.h>
#include <igtlPointMessage.h>
#include <igtlPolyDataMessage.h>
#include <igtlStringMessage.h>
#include <igtlTrackingDataMessage.h>
#include <igtlTransformMessage.h>

using Clock = std::chrono::steady_clock;

static igtl::ClientSocket::Pointer line;

static double msSince(Clock::time_point begun) {
  return std::chrono::duration<double, std::milli>(Clock::now() - begun).count();
}

static void fail(const std::string& what) {
  std::fprintf(stderr, "%s\n", what.c_str());
  std::exit(1);
}

template <class M> static typename M::Pointer body(igtl::MessageHeader::Pointer header) {
  typename M::Pointer found = M::New();
  found->SetMessageHeader(header);
  found->AllocatePack();
  int size = found->GetPackBodySize();
  if (size > 0 && line->Receive(found->GetPackBodyPointer(), size) != size) fail("ended within a body");
  return found;
}

template <class M> static void unpack(M found, const std::string& name, int size) {
  if (size > 0 && !(found->Unpack(1) & igtl::MessageHeader::UNPACK_BODY)) fail("checksum of " + name);
}

static void printMesh(igtl::PolyDataMessage::Pointer mesh, double ms, unsigned stamp) {
  double blocked = 0, least = 1e9;
  std::vector<float> values;
  for (int i = 0; i < mesh->GetNumberOfAttributes(); i++) {
    igtl::PolyDataAttribute* one = mesh->GetAttribute(i);
    values.resize(one->GetSize());
    one->GetData(values.data());
    for (float value : values) {
      if (std::string(one->GetName()) == "blocked") blocked += value;
      else if (value < least) least = value;
    }
    if (one->GetType() != igtl::PolyDataAttribute::POINT_SCALAR) fail("scalars of no points");
  }
  int cells = mesh->GetPolygons() ? mesh->GetPolygons()->GetNumberOfCells() : 0;
  std::printf("map %.3f %d %d %g %g %u\n", ms, mesh->GetPoints()->GetNumberOfPoints(), cells, blocked / 4, least, stamp);
}

// Read and print messages up to the one of this name; returns the fraction of its time stamp.
static unsigned readUntil(const std::string& last, Clock::time_point begun, bool quiet = false) {
  for (;;) {
    igtl::MessageHeader::Pointer header = igtl::MessageHeader::New();
    header->InitPack();
    if (line->Receive(header->GetPackPointer(), header->GetPackSize()) != header->GetPackSize()) fail("hung up");
    header->Unpack();
    std::string kind = header->GetDeviceType(), name = header->GetDeviceName();
    unsigned seconds = 0, stamp = 0;
    header->GetTimeStamp(&seconds, &stamp);
    int size = header->GetBodySizeToRead();
    if (kind == "POLYDATA") {
      igtl::PolyDataMessage::Pointer mesh = body<igtl::PolyDataMessage>(header);
      double ms = msSince(begun);
      unpack(mesh, name, size);
      if (!quiet) printMesh(mesh, ms, stamp);
    } else if (kind == "IMAGE") {
      igtl::ImageMessage::Pointer image = body<igtl::ImageMessage>(header);
      unpack(image, name, size);
      int dimensions[3];
      float origin[3];
      image->GetDimensions(dimensions);
      image->GetOrigin(origin);
      if (!quiet) std::printf("grid %d %d %g %g\n", dimensions[0], dimensions[1], origin[0], origin[1]);
    } else if (kind == "STRING") {
      igtl::StringMessage::Pointer text = body<igtl::StringMessage>(header);
      double ms = msSince(begun);
      unpack(text, name, size);
      if (!quiet && name == "Verdict") std::printf("verdict %.3f %u %s\n", ms, stamp, text->GetString());
      else if (!quiet) std::printf("info %s\n", text->GetString());
    } else if (kind == "POINT") {
      igtl::PointMessage::Pointer points = body<igtl::PointMessage>(header);
      unpack(points, name, size);
      float place[3] = {0, 0, 0};
      std::string label;
      if (points->GetNumberOfPointElement() > 0) {
        igtl::PointElement::Pointer one;
        points->GetPointElement(0, one);
        one->GetPosition(place);
        label = one->GetName();
      }
      if (!quiet)
        std::printf("entry %d %.4f %.4f %.4f %s\n", points->GetNumberOfPointElement(), place[0], place[1], place[2], label.c_str());
    } else {
      fail("an answer of type " + kind);
    }
    if (name == last) return stamp;
  }
}

static void send(igtl::MessageBase* message, unsigned stamp) {
  message->SetTimeStamp(1000, stamp);
  message->Pack();
  if (!line->Send(message->GetPackPointer(), message->GetPackSize())) fail("not sent");
}

// A needle 150 mm in front of the target, in RAS: its tip is there, its axis points to the back.
static void needleAt(igtl::Matrix4x4& T, float x, float y, float z) {
  igtl::IdentityMatrix(T);
  T[1][1] = 0; T[2][1] = 1; T[1][2] = -1; T[2][2] = 0;
  T[0][3] = x; T[1][3] = y + 150; T[2][3] = z;
}

int main(int count, char** words) {
  if (count != 6) fail("live_client PORT ROUNDS X Y Z");
  int rounds = std::atoi(words[2]);
  float x = std::atof(words[3]), y = std::atof(words[4]), z = std::atof(words[5]);
  line = igtl::ClientSocket::New();
  if (line->ConnectToServer("127.0.0.1", std::atoi(words[1])) != 0) fail("nobody there");
  igtl::Matrix4x4 T;
  for (int i = 0; i < rounds; i++) {
    float at = z + 0.01f * i;
    igtl::PointMessage::Pointer target = igtl::PointMessage::New();
    target->SetDeviceName("Target");
    igtl::PointElement::Pointer place = igtl::PointElement::New();
    place->SetPosition(x, y, at);
    target->AddPointElement(place);
    Clock::time_point begun = Clock::now();
    send(target, 2 * i);
    readUntil("SafeMapInfo", begun);
    if (i > 0) readUntil("Entry", begun);  // of the needle that is known, for the new target
    igtl::TransformMessage::Pointer needle = igtl::TransformMessage::New();
    needle->SetDeviceName("Needle");
    needleAt(T, x, y, at);
    needle->SetMatrix(T);
    begun = Clock::now();
    send(needle, 2 * i + 1);
    readUntil("Entry", begun);
  }
  const unsigned sent = 50;
  std::vector<Clock::time_point> at(sent + 1);
  std::thread tracker([&] {
    Clock::time_point begun = Clock::now();
    for (unsigned i = 1; i <= sent; i++) {
      std::this_thread::sleep_until(begun + std::chrono::milliseconds(20 * i));
      igtl::TrackingDataMessage::Pointer data = igtl::TrackingDataMessage::New();
      data->SetDeviceName("Tracker");
      igtl::TrackingDataElement::Pointer tool = igtl::TrackingDataElement::New();
      tool->SetName("Needle");
      tool->SetType(igtl::TrackingDataElement::TYPE_6D);
      needleAt(T, x, y, z + 0.1f * i);
      tool->SetMatrix(T);
      data->AddTrackingDataElement(tool);
      at[i] = Clock::now();
      send(data, i);
    }
  });
  int answers = 0;
  double oldest = 0;
  for (unsigned answered = 0; answered != sent; answers++) {
    answered = readUntil("Entry", Clock::now(), true);
    oldest = std::max(oldest, msSince(at[answered]));
  }
  tracker.join();
  std::printf("tracked %u %d %.3f\n", sent, answers, oldest);
  return 0;
}
