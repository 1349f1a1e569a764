//! Health as the gRPC health service tells it: serving means that records are kept and work is given out.

use tokio::sync::Mutex;
use tonic_health::ServingStatus;
use tonic_health::pb::health_server::HealthServer;
use tonic_health::server::{HealthReporter, HealthService};

/// What is reported on: the server as a whole, and each service.
const SERVICES: [&str; 3] = ["", "ambience.v1.Cache", "ambience.v1.Frames"];

/// The health service itself serves whenever it answers: a full disk is no reason to start a server again.
const ALIVE: &str = "grpc.health.v1.Health";

/// Largest message that asks, bytes: the name of a service.
const MESSAGE_MAX: usize = 1 << 10;

/// The health of one server, on all its sockets.
#[derive(Debug, Default)]
pub struct Health {
    reporter: HealthReporter,
    told: Mutex<Option<bool>>,
}

impl Health {
    /// The service that tells it.
    pub fn service(&self) -> HealthServer<HealthService> {
        let service = HealthService::from_health_reporter(self.reporter.clone());
        HealthServer::new(service).max_decoding_message_size(MESSAGE_MAX)
    }

    /// Tells whether the server is ready; those who watch hear of changes only.
    pub async fn tell(&self, ready: bool) {
        let mut told = self.told.lock().await;
        if told.replace(ready) == Some(ready) {
            return;
        }
        let status = if ready { ServingStatus::Serving } else { ServingStatus::NotServing };
        for service in SERVICES {
            self.reporter.set_service_status(service, status).await;
        }
        self.reporter.set_service_status(ALIVE, ServingStatus::Serving).await;
    }

    /// Tells that the server is going away, and sends away those who watch.
    pub async fn close(&self) {
        self.tell(false).await;
        for service in SERVICES.into_iter().chain([ALIVE]) {
            self.reporter.clone().clear_service_status(service).await;
        }
    }
}
